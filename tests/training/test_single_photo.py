"""Runs on a single photo complete what it does not show; runs on few photos warn about what they leave open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from balls import Ball, ring, write_balls
from tiny_scenes import tiny_config

from gsopt.config.train import DataConfig, InitConfig, PoseConfig, SparseConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.events import read_events
from gsopt.metrics import psnr
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings
from gsopt.training.few_photos import few_photo_warnings
from gsopt.training.loop import TrainResult, train
from gsopt.training.open_settings import FEW_OF_AN_OBJECT
from gsopt.training.plan import RunPlan

pytestmark = pytest.mark.usefixtures("coarse_hull")

BALL = [Ball((0.1, 0.0, 0.0), 0.6, (200, 60, 30)), Ball((-0.5, 0.2, 0.3), 0.25, (200, 60, 30))]


@pytest.fixture(scope="module")
def one_photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls, as no axis has them, seen by one camera; seven others are held out."""
    around = ring(8, size=48)
    return write_balls(tmp_path_factory.mktemp("one") / "ball", BALL, around[0], around[1:])


def config_of(dataset: Path, **changes: object) -> TrainConfig:
    config = tiny_config(dataset, iterations=60, init=InitConfig("auto", 800), sparse=SparseConfig(steps_per_view=0))
    return replace(config, **changes)  # type: ignore[arg-type]


def held_out_psnr(result: TrainResult) -> float:
    backend = make_backend("cpu", 1)
    values = []
    for view in result.scene.test:
        pixels = view.pixels().float() / 255
        truth = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
        drawn = backend.forward(result.gaussians, view.camera, RasterSettings(sh_degree=0), truth.new_ones(3)).colors
        values.append(float(psnr(drawn[None].clamp(0, 1), truth[None])))
    return sum(values) / len(values)


def test_what_one_photo_does_not_show_is_completed(one_photo: Path, tmp_path: Path) -> None:
    completed = train(config_of(one_photo, iterations=200), tmp_path / "on")
    sparse = SparseConfig(steps_per_view=0, inflate="off")
    photo_alone = train(config_of(one_photo, iterations=200, sparse=sparse), tmp_path / "off")
    assert len(completed.scene.guessed) > 0
    assert photo_alone.scene.guessed == ()
    assert held_out_psnr(completed) > held_out_psnr(photo_alone) + 1
    events, _ = read_events(tmp_path / "on" / "events.jsonl")
    started = next(event for event in events if event["kind"] == "started")
    assert started["guessed"] == len(completed.scene.guessed)
    warnings = [event["message"] for event in events if event["kind"] == "warning"]
    assert any("a guess" in message for message in warnings)


def test_a_guess_doubles_the_steps_that_a_photo_is_given(one_photo: Path) -> None:
    scene = load_scene(DataConfig(path=str(one_photo)))
    config = TrainConfig(data=DataConfig(path=str(one_photo)))
    guessed = replace(scene, guessed=scene.train)
    assert RunPlan.of(config, scene).schedule.iterations == FEW_OF_AN_OBJECT.steps_per_view
    assert RunPlan.of(config, guessed).schedule.iterations == 2 * FEW_OF_AN_OBJECT.steps_per_view
    assert RunPlan.of(config, guessed).extra_per_epoch == 1


def test_poses_that_are_refined_get_no_guess(one_photo: Path, tmp_path: Path) -> None:
    config = config_of(one_photo, iterations=2, poses=PoseConfig(refine=True))
    assert train(config, tmp_path / "run").scene.guessed == ()


def test_few_photos_without_masks_are_told_what_to_add(one_photo: Path) -> None:
    scene = load_scene(DataConfig(path=str(one_photo)))
    assert few_photo_warnings(scene) == ()
    (warning,) = few_photo_warnings(replace(scene, has_alpha=False))
    assert "masks/" in warning
    assert few_photo_warnings(replace(scene, has_alpha=False, train=4 * scene.train)) == ()


def test_stopped_and_resumed_is_the_run_that_never_stopped(one_photo: Path, tmp_path: Path) -> None:
    config = config_of(one_photo, iterations=20, checkpoint_every=5)
    whole = train(config, tmp_path / "whole")
    stop = tmp_path / "parts" / "stop"

    def stop_at_ten(event: dict) -> None:
        if event["kind"] == "preview" or event.get("step") == 10:
            stop.touch()

    train(replace(config, preview_every=10), tmp_path / "parts", on_progress=stop_at_ten)
    train(replace(config, preview_every=10), tmp_path / "parts", resume=True)
    assert (tmp_path / "parts" / "splat.ply").read_bytes() == (whole.run / "splat.ply").read_bytes()
