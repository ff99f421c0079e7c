"""Views between few photos of a masked object lose their haze, and nothing else of a run changes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from balls import Ball, ring, write_balls
from tiny_scenes import tiny_config

from gsopt.config.train import DataConfig, SparseConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus
from gsopt.init.first_gaussians import first_gaussians
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.training.loop import train
from gsopt.training.unseen_views import COUNT, FROM_SHARE, NEEDED, SOLID, TURN, UnseenViews, haze_gradient

pytestmark = pytest.mark.usefixtures("coarse_hull")

BALLS = [Ball((0.1, 0.0, 0.0), 0.5, (200, 60, 30)), Ball((-0.5, 0.2, 0.3), 0.25, (40, 60, 200))]
STEPS = 100


@pytest.fixture(scope="module")
def two_photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls seen by two cameras; four others are held out."""
    around = ring(8, size=48)
    return write_balls(tmp_path_factory.mktemp("two") / "balls", BALLS, around[::3][:2], around[4:])


@pytest.fixture(scope="module")
def scene(two_photos: Path) -> Scene:
    return load_scene(DataConfig(path=str(two_photos)))


@pytest.fixture
def unseen(scene: Scene) -> UnseenViews:
    made = UnseenViews.of(scene, 0.1, STEPS)
    assert made is not None
    return made


def zeros(count: int) -> Gradients:
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh0": (1, 3), "means2d": (2,)}
    made = {name: torch.zeros(count, *shape) for name, shape in shapes.items()}
    return Gradients(**made, shN=None, means2d_abs=None)


def test_the_gradient_is_that_of_the_term() -> None:
    alphas = torch.rand(5, 7, generator=torch.Generator().manual_seed(1), dtype=torch.float64).requires_grad_()
    (expected,) = torch.autograd.grad(0.3 * (alphas * (2 * SOLID - alphas)).mean(), alphas)
    torch.testing.assert_close(haze_gradient(alphas.detach(), 0.3), expected)
    thin, dense = haze_gradient(torch.tensor([[SOLID - 0.1, SOLID + 0.1]]), 0.3)[0]
    assert dense < 0 < thin


def test_the_cameras_surround_what_the_photos_look_at(scene: Scene, unseen: UnseenViews) -> None:
    cameras = [view.camera for view in scene.train]
    focus = find_focus(cameras, scene.extent).point
    toward = torch.nn.functional.normalize(focus - unseen.cameras.centers, dim=1)
    torch.testing.assert_close((toward * unseen.cameras.forwards).sum(1), torch.ones(COUNT))
    assert (unseen.cameras.width, unseen.cameras.height) == (24, 24)
    assert math.gcd(TURN, COUNT) == 1  # else some cameras never take their turn


def test_the_term_asks_for_an_opacity_of_four_fifths() -> None:
    """It pulls neither way there, and falls off linearly: weight 0.3 over two pixels."""
    found = haze_gradient(torch.tensor([[0.8, 0.0]], dtype=torch.float64), 0.3)
    assert found.tolist() == [[pytest.approx(0.0), pytest.approx(0.3 * 0.8)]]


def test_sixteen_cameras_take_turns_every_fourth_step_seven_apart(unseen: UnseenViews) -> None:
    """From three tenths of the run on; each once before any comes again, and the nearest not one after the other."""
    asked: list[torch.Tensor] = []
    steps: list[int] = []

    class Asked(Exception):
        pass

    def forward(gaussians: object, camera: Cameras, *_: object) -> None:
        asked.append(camera.centers[0])
        raise Asked

    backend: Any = SimpleNamespace(forward=forward)
    nothing: Any = None
    for step in range(1, 93):
        try:
            unseen.add(step, nothing, backend, nothing)
        except Asked:
            steps.append(step)
    assert steps == list(range(32, 93, 4))
    rows = [int((unseen.cameras.centers - center).norm(dim=1).argmin()) for center in asked]
    assert sorted(rows) == list(range(16))
    assert {(b - a) % 16 for a, b in itertools.pairwise(rows)} == {7}


def test_thin_matter_fades(scene: Scene, unseen: UnseenViews) -> None:
    gaussians, _ = first_gaussians(scene, replace(tiny_config(Path("."), iterations=1).init, count=800), 0, seed=0)
    thin = replace(gaussians, logit_opacities=torch.full((len(gaussians),), -4.0))
    gradients = zeros(len(thin))
    unseen.add(STEPS, thin, make_backend("cpu", 1), gradients)
    assert float(gradients.logit_opacities.min()) >= 0 < float(gradients.logit_opacities.max())
    assert all(bool(getattr(gradients, name).any()) for name in NEEDED)
    assert not gradients.sh0.any()


def test_the_photos_come_first_and_steps_between_are_free(scene: Scene, unseen: UnseenViews) -> None:
    gaussians, _ = first_gaussians(scene, tiny_config(Path("."), iterations=1).init, 0, seed=0)
    for step in (1, round(FROM_SHARE * STEPS) - 2, STEPS - 2):
        gradients = zeros(len(gaussians))
        unseen.add(step, gaussians, make_backend("cpu", 1), gradients)
        assert not any(bool(getattr(gradients, name).any()) for name in NEEDED)


def test_one_photo_scenes_without_masks_and_a_weight_of_zero_do_without(scene: Scene) -> None:
    assert UnseenViews.of(replace(scene, train=scene.train * 8), 0.1, STEPS) is not None
    assert UnseenViews.of(scene, 0.0, STEPS) is None
    assert UnseenViews.of(replace(scene, train=scene.train[:1]), 0.1, STEPS) is None
    assert UnseenViews.of(replace(scene, has_alpha=False), 0.1, STEPS) is None


def test_a_run_ends_with_less_haze_in_held_out_views(two_photos: Path, tmp_path: Path) -> None:
    backend = make_backend("cpu", 1)
    haze = {}
    for weight in (0.0, 0.5):
        sparse = SparseConfig(steps_per_view=0, lambda_unseen=weight, symmetry="off", dropout=0.0)
        result = train(tiny_config(two_photos, iterations=3 * STEPS, sparse=sparse), tmp_path / str(weight))
        alphas = [
            backend.forward(result.gaussians, view.camera, RasterSettings(sh_degree=0), torch.zeros(3)).alphas
            for view in result.scene.test
        ]
        haze[weight] = float(torch.stack([(alpha * (1 - alpha)).mean() for alpha in alphas]).mean())
    assert haze[0.5] < 0.9 * haze[0.0]
