"""Decisions of the guard."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import InitConfig, TrainConfig
from gsopt.geometry.cameras import Cameras
from gsopt.raster.reference import ReferenceBackend
from gsopt.sds.guidance_step import GuidanceSetup
from gsopt.training.guided import guard


@pytest.mark.parametrize(
    ("losses", "factor"), [((0.0,), 1.0), ((0.01, 0.0), 0.5), ((0.9, 0.5, -0.1), 0.25), ((0.5, 0.5, 0.01), 0.0)]
)
def test_a_text_prior_that_loses_a_fraction_of_a_decibel_gets_a_lower_factor(
    losses: tuple[float, ...], factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = iter([20.0, *(20.0 - loss for loss in losses)])
    monkeypatch.setattr(guard, "_mean_psnr", lambda *args: next(measured))
    setup = GuidanceSetup(None, None, None, 0.2, print)  # type: ignore[arg-type]
    verdict = guard._check_guided_runs(guard.ShortRun(TrainConfig(), ReferenceBackend()), [], setup)
    assert verdict.factor == factor
    assert [trial["factor"] for trial in verdict.trials] == list(guard.FACTORS[: len(losses)])


@pytest.mark.parametrize(("size", "halvings"), [((128, 128), 0), ((800, 600), 3), ((64, 256), 1), ((9, 12000), 6)])
def test_a_short_run_sees_photos_of_about_128_pixels(size: tuple[int, int], halvings: int) -> None:
    """The longest side of all photos decides, whichever side that is and in whichever photo."""
    cameras = [Cameras(torch.eye(4)[None], torch.eye(3)[None], *sides) for sides in ((8, 8), size, (16, 8))]
    scene = SimpleNamespace(train=[SimpleNamespace(camera=camera) for camera in cameras])
    config = TrainConfig(init=InitConfig("hull", 100), guidance=GuidanceConfig(guard_steps=48))
    short = guard.short_config(config, scene, view_conditioned=True)  # type: ignore[arg-type]
    assert short.schedule.coarse_until == tuple(range(48, 48 + halvings))
    assert short.init == InitConfig("auto", 100)
    assert (short.density.refine_start, short.density.refine_stop) == (48, 48)
    assert short.guidance.every in (1, 2)
    assert short.guidance.refresh_every == 6
    many = replace(config, init=InitConfig("random", 10**6))
    assert guard.short_config(many, scene, view_conditioned=True).init == InitConfig("random", 5000)  # type: ignore[arg-type]
