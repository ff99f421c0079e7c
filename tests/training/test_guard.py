"""Decisions of the guard."""

from __future__ import annotations

import pytest

from gsopt.config.train import TrainConfig
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
