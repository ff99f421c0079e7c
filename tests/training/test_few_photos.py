"""Runs on one to three photos say what is wrong with these, and never lose the reconstruction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from balls import FIELD_OF_VIEW, Ball, picture, write_balls
from PIL import Image
from tiny_scenes import tiny_config

from gsopt.config.train import InitConfig, SparseConfig
from gsopt.data.scene import load_scene
from gsopt.events import read_events
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.training.few_photos import GUESSED, TURNED, few_photo_warnings
from gsopt.training.loop import train

pytestmark = pytest.mark.usefixtures("coarse_hull")

THING = [Ball((0.1, 0.0, 0.0), 0.5), Ball((-0.4, 0.2, 0.3), 0.2, (40, 90, 220))]
TWO_THINGS = [Ball((0.6, 0.5, 0.0), 0.25), Ball((-0.5, -0.6, 0.1), 0.25)]
EYES = [(3.5, 0.5, 1.5), (0.5, 3.5, 1.2), (-3.0, -2.0, 1.0)]
SIZE = 64


def cameras(eyes: list[tuple[float, float, float]], targets: list[tuple[float, float, float]]) -> Cameras:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    poses = [
        look_at(torch.tensor([eye], dtype=torch.float64), torch.tensor(target, dtype=torch.float64), up)
        for eye, target in zip(eyes, targets, strict=True)
    ]
    return Cameras(torch.cat(poses), intrinsics(FIELD_OF_VIEW, SIZE, SIZE).expand(len(eyes), 3, 3), SIZE, SIZE)


def write(folder: Path, views: int, what: str) -> Path:
    """A dataset of so many photos with one fault."""
    middle, eyes = (0.0, 0.0, 0.0), EYES[:views]
    targets = [(0.0, 0.0, 0.9) if what == "cut" else (0.3, 0.3, 0.3) if what == "off center" else middle] * views
    posed = cameras([EYES[0]] * views if what == "identical" else eyes, targets)
    if what == "apart":  # photos of the thing, with poses that look away from it
        posed = cameras(eyes, [(2 * x, 2 * y, 2 * z) for x, y, z in eyes])
    balls = TWO_THINGS if what == "two things" else THING
    write_balls(folder, balls, posed)
    seen = cameras(eyes, targets)
    for row in range(views):
        pixels = picture(seen[row] if what == "apart" else posed[row], balls)
        if what in ("one pixel", "empty"):
            pixels[..., 3] = 0
            pixels[SIZE // 2, SIZE // 2, 3] = 255 * (what == "one pixel")
        if what == "covered":
            pixels[..., 3] = 255
        Image.fromarray(np.ascontiguousarray(pixels[..., : 3 if what == "no mask" else 4])).save(
            folder / "train" / f"r_{row}.png"
        )
    return folder


@pytest.mark.parametrize("views", [1, 2, 3])
@pytest.mark.parametrize(
    ("what", "told"),
    [
        ("no mask", "without masks"),
        ("one pixel", "holds 1 pixels, too few for a shape"),
        ("empty", "holds 0 pixels"),
        ("covered", "covers 100% of it and outlines nothing"),
        ("cut", "cuts the object off at its border"),
        ("identical", "they show the same side"),
        ("apart", "The cameras look apart"),
        ("two things", ""),
        ("off center", ""),
    ],
)
def test_a_fault_is_told_and_the_run_ends_with_splats(what: str, told: str, views: int, tmp_path: Path) -> None:
    if views == 1 and what in ("identical", "apart"):
        pytest.skip("one camera has no other")
    data = write(tmp_path / "scene", views, what)
    sparse = SparseConfig(steps_per_view=0)
    config = tiny_config(data, iterations=3, init=InitConfig("auto", 200), sparse=sparse, preview_every=0)
    result = train(config, tmp_path / "run")
    events, _ = read_events(tmp_path / "run" / "events.jsonl")
    warnings = [event["message"] for event in events if event["kind"] == "warning"]
    faults = [warning for warning in warnings if warning not in (GUESSED, TURNED)]
    assert all(told in fault for fault in faults)
    assert bool(faults) == bool(told)
    assert len(result.gaussians) > 0
    assert bool(result.gaussians.means.isfinite().all())


def test_photos_without_a_fault_are_warned_of_nothing_but_the_guess(tmp_path: Path) -> None:
    for views in (2, 3):
        assert few_photo_warnings(load_scene(write(tmp_path / str(views), views, "none"))) == ()
