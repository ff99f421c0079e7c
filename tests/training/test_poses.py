"""Laws of learned poses: the gradient is the central difference, a disturbed camera finds home, a resumed run is the
run that was not stopped (that one stands in test_resume.py)."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_scenes import cloud, ring, tiny_config

from gsopt import cli
from gsopt.config.train import PoseConfig, SparseConfig
from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, UsageError
from gsopt.geometry.rigid_motion import rigid_motion
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.training.loop import train
from gsopt.training.poses import PoseRefinement, pose_gradient

STEP = 1e-5
"""Step of the central differences; their error is about its square."""


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_gradient_of_a_pose_is_its_central_difference(degree: int, antialiased: bool) -> None:
    backend = ReferenceBackend(smooth_cutoff=True)
    gaussians = cloud(12, seed=3, sh_degree=3).to(torch.float64)
    camera = ring(5, height=1.0)[1]
    settings = RasterSettings(sh_degree=degree, antialiased=antialiased)
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)).double()

    def loss(xi: torch.Tensor) -> float:
        moved = replace(camera, viewmats=(rigid_motion(xi) @ camera.viewmats[0])[None])
        return float((backend.forward(gaussians, moved, settings).colors * weights).sum())

    gradients = backend.backward(backend.forward(gaussians, camera, settings), weights, None)
    units = STEP * torch.eye(6, dtype=torch.float64)
    differences = torch.tensor([(loss(unit) - loss(-unit)) / (2 * STEP) for unit in units], dtype=torch.float64)
    found = pose_gradient(camera.viewmats[0], gaussians, gradients, degree)
    assert float(differences.abs().min()) > 1e-3, "every direction must be tried"
    torch.testing.assert_close(found, differences, rtol=1e-5, atol=1e-6)


def test_a_small_motion_is_rigid_and_its_own_inverse_backwards() -> None:
    xi = torch.tensor([0.3, -0.2, 0.9, 1.0, 2.0, 3.0], dtype=torch.float64)
    motion = rigid_motion(xi)
    torch.testing.assert_close(motion[:3, :3] @ motion[:3, :3].mT, torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(motion[:3, :3] @ rigid_motion(-xi)[:3, :3], torch.eye(3, dtype=torch.float64))
    cosine = (float(motion[:3, :3].trace()) - 1) / 2
    assert math.isclose(math.acos(cosine), float(xi[:3].norm()))


def test_a_disturbed_camera_finds_home(dataset: Path) -> None:
    """The Gaussians are the truth and stay; only the pose of one view is learned."""
    scene = load_scene(dataset)
    backend, truth = ReferenceBackend(), cloud(40, seed=7)
    refinement = PoseRefinement(PoseConfig(refine=True, lr=3e-3, lr_final=1e-4, start=0), scene, 150)
    home = refinement.given[0].clone()
    camera = scene.train[0].camera
    target = backend.forward(truth, camera, RasterSettings(sh_degree=1)).colors
    refinement.viewmats[0] = rigid_motion(torch.tensor([0.01, -0.006, 0.008, 0.02, 0.01, -0.03]).double()) @ home
    before = off_target(refinement.viewmats[0], home, truth.means)
    for step in range(1, 151):
        frame = backend.forward(truth, refinement.camera(0, camera), RasterSettings(sh_degree=1))
        v_colors = 2 * (frame.colors - target) / target.numel()
        refinement.update(0, step, truth, backend.backward(frame, v_colors, None), sh_degree=1)
    assert off_target(refinement.viewmats[0], home, truth.means) < 0.01 * before
    degrees, distances = refinement.moved()
    assert float(degrees[0]) < 0.02, "turning and shifting, which look nearly the same, must be told apart"
    assert float(degrees[1:].max()) == 0 == float(distances[1:].max())


def off_target(viewmat: torch.Tensor, home: torch.Tensor, points: torch.Tensor) -> float:
    """Largest angle by which a point is seen in the wrong direction, radians."""
    seen = [points.double() @ V[:3, :3].mT + V[:3, 3] for V in (viewmat, home)]
    a, b = (torch.nn.functional.normalize(rays, dim=1) for rays in seen)
    return float((a - b).norm(dim=1).max())


def test_poses_stay_as_given_until_start_and_without_the_flag(dataset: Path, tmp_path: Path) -> None:
    base = replace(tiny_config(dataset), sparse=SparseConfig(below_views=0))
    train(base, tmp_path / "off")
    train(replace(base, poses=PoseConfig(refine=True, start=base.iterations)), tmp_path / "late")
    assert (tmp_path / "off/splat.ply").read_bytes() == (tmp_path / "late/splat.ply").read_bytes()
    assert not (tmp_path / "off/poses.json").exists()
    views = json.loads((tmp_path / "late/poses.json").read_text())["views"]
    given = {view.name: view.camera.viewmats[0].tolist() for view in load_scene(dataset).train}
    assert {view["name"]: view["cam_from_world"] for view in views} == given


def test_a_rate_that_makes_no_sense_is_refused(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UsageError, match=r"`poses\.lr"):
        PoseConfig(lr=0.0)
    assert cli.main(["train", str(dataset), "--refine-poses", "--poses.start", "-1"]) == UsageError.exit_code
    assert "`--poses.start` must be at least 0, got -1" in capsys.readouterr().err


def test_a_run_is_judged_and_drawn_where_it_put_its_views(dataset: Path, tmp_path: Path) -> None:
    """Written in the source's frame, read into the scene's, which may be moved; views it does not name stay."""
    scene = replace(load_scene(dataset), origin=(5.0, -3.0, 2.0))
    assert with_refined_poses(scene, tmp_path) is scene
    refinement = PoseRefinement(PoseConfig(refine=True), scene, 10)
    refinement.viewmats[1] = rigid_motion(torch.tensor([0.1, 0.0, 0.2, 0.3, 0.0, 0.1]).double()) @ refinement.given[1]
    record = refinement.record(scene.origin)
    del record["views"][0]
    (tmp_path / "poses.json").write_text(json.dumps(record))
    moved = with_refined_poses(scene, tmp_path)
    found = torch.cat([view.camera.viewmats for view in moved.train]).double()
    torch.testing.assert_close(found, refinement.viewmats, atol=1e-5, rtol=0)
    assert moved.train[0] is scene.train[0]


@pytest.mark.parametrize("views", [3, [3], [{"name": "a"}], [{"name": "a", "cam_from_world": [[2, 0, 0, 0]] * 4}]])
def test_refined_poses_that_are_garbled_are_named(views: object, dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "poses.json").write_text(json.dumps({"views": views}))
    with pytest.raises(InputError, match=r"poses\.json"):
        with_refined_poses(load_scene(dataset), tmp_path)
