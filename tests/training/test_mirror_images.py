"""Runs of symmetric things learn from the mirror images of their photos."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import Ball, mirrored, ring, write_balls
from tiny_scenes import tiny_config

from gsopt.cli.console import RunConsole
from gsopt.config.train import InitConfig, PoseConfig, SparseConfig, TrainConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.errors import InputError
from gsopt.events import read_events
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.metrics import psnr
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings
from gsopt.symmetry.find import with_mirror_images
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.symmetry import Symmetry
from gsopt.training.guided.guard import without
from gsopt.training.loop import train
from gsopt.training.targets import Targets

pytestmark = pytest.mark.usefixtures("coarse_hull")

X = Mirror(torch.tensor([1.0, 0, 0]), 0.0)
HALF = [
    Ball((0.15, 0.0, 0.0), 0.5, (150, 150, 150)),
    Ball((0.6, 0.15, 0.2), 0.25, (220, 30, 20)),
    Ball((0.5, -0.35, -0.15), 0.2, (20, 40, 220)),
    Ball((0.3, 0.4, 0.45), 0.15, (20, 160, 40)),
]


@pytest.fixture(scope="module")
def one_sided(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A symmetric thing, seen from one side by 3 cameras; those held out stand on the other."""
    around = ring(12, size=48)
    near, far = ([row for row, eye in enumerate(around.centers) if way * float(eye[0]) > 0.5] for way in (1, -1))
    views, held_out = (Cameras.cat([around[row] for row in rows]) for rows in (near[::2], far[::2]))
    return write_balls(tmp_path_factory.mktemp("balls") / "thing", mirrored(HALF, X), views, held_out)


def config_of(dataset: Path, **changes: object) -> TrainConfig:
    config = tiny_config(dataset, iterations=150, checkpoint_every=50, preview_every=70, init=InitConfig("hull", 1500))
    return replace(config, sparse=SparseConfig(steps_per_view=0), **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def short_run(one_sided: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("short") / "run"
    train(config_of(one_sided, iterations=2), run)
    return run


def started(run: Path) -> dict:
    return next(event for event in read_events(run / "events.jsonl")[0] if event["kind"] == "started")


def held_out_psnr(gaussians: Gaussians, scene: Scene) -> float:
    white, backend = torch.ones(3), make_backend("reference")
    targets = [Targets(scene.test, white, 0).get(row, 1, white) for row in range(len(scene.test))]
    settings = RasterSettings(sh_degree=gaussians.sh_degree)
    drawn = [backend.forward(gaussians, target.camera, settings, white).colors for target in targets]
    return sum(float(psnr(d[None], t.colors[None])) for d, t in zip(drawn, targets, strict=True)) / len(targets)


def test_the_side_that_no_photo_shows_is_learned_from_the_other(one_sided: Path, tmp_path: Path) -> None:
    config = config_of(one_sided)
    without_mirrors = replace(config, sparse=replace(config.sparse, symmetry="off"))
    with_them, alone = train(config, tmp_path / "mirrors"), train(without_mirrors, tmp_path / "alone")
    assert (started(tmp_path / "mirrors")["mirrors"], started(tmp_path / "alone")["mirrors"]) == (1, 0)
    assert held_out_psnr(with_them.gaussians, with_them.scene) > held_out_psnr(alone.gaussians, alone.scene) + 0.5


def test_a_resumed_run_keeps_its_mirrors_and_its_bits(one_sided: Path, tmp_path: Path) -> None:
    config = config_of(one_sided)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    train(config, whole)

    def stop(event: dict) -> None:
        if event["kind"] == "preview" and event["step"] >= 60:
            (broken / "stop").touch()

    train(config, broken, on_progress=stop)
    recorded = json.loads((broken / "config.json").read_text())["symmetry"]
    assert len(recorded) == 1
    train(config, broken, resume=True)
    assert json.loads((broken / "config.json").read_text())["symmetry"] == recorded
    assert (broken / "splat.ply").read_bytes() == (whole / "splat.ply").read_bytes()


@pytest.mark.parametrize(
    "garbled",
    [
        [{"normal": [1, 0]}],
        [{"normal": [1, 0], "offset": 0, "misses": 0, "disagreement": 0}],
        [{"normal": [1, 0, float("nan")], "offset": 0, "misses": 0, "disagreement": 0}],
        [{"normal": [1, 1, 1], "offset": 0, "misses": 0, "disagreement": 0}],
        [{"offset": "x"}],
        [7],
        "x",
    ],
)
def test_garbled_mirrors_are_refused(garbled: object, one_sided: Path, short_run: Path, tmp_path: Path) -> None:
    config, run = config_of(one_sided, iterations=2), shutil.copytree(short_run, tmp_path / "run")
    document = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**document, "symmetry": garbled}))
    with pytest.raises(InputError, match="symmetry"):
        train(config, run, resume=True)


def test_nobody_looks_for_mirrors_where_poses_move_or_views_are_many(one_sided: Path, tmp_path: Path) -> None:
    short = config_of(one_sided, iterations=2)
    train(replace(short, poses=PoseConfig(refine=True)), tmp_path / "poses")
    train(replace(short, sparse=replace(short.sparse, below_views=2)), tmp_path / "many")
    assert [started(tmp_path / run)["mirrors"] for run in ("poses", "many")] == [0, 0]


def test_a_view_that_is_left_out_takes_its_mirror_images_along(one_sided: Path) -> None:
    scene = load_scene(str(one_sided))
    whole = with_mirror_images(scene, [Symmetry(X, 0.0, 0.0), Symmetry(X, 0.0, 1.0)])
    left = without(whole, 1)
    assert left.view == scene.train[1]
    assert len(left.scene.mirrored) == 2 * (len(scene.train) - 1)
    assert not any(view.index == left.view.index for view in left.scene.drawn)


@pytest.mark.parametrize("seed", range(3))
def test_a_run_of_one_step_ends_well_whatever_it_draws(seed: int, one_sided: Path, tmp_path: Path) -> None:
    """There is no loss to tell of as long as only mirror images were drawn."""
    train(config_of(one_sided, iterations=1, seed=seed), tmp_path / "run", on_progress=RunConsole(tmp_path / "run"))
    losses = [event["loss"] for event in read_events(tmp_path / "run" / "events.jsonl")[0] if "loss" in event]
    assert None not in losses
