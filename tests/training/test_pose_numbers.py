"""Numbers of learned poses against independent formulas: motions, whitening, Adam's steps, distances, records."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from tiny_scenes import cloud, ring

from gsopt.config.train import PoseConfig
from gsopt.geometry.rigid_motion import rigid_motion
from gsopt.raster.backend import Gradients
from gsopt.training import poses
from gsopt.training.poses import BETA1, BETA2, PoseRefinement, pose_gradient, whitening


def skew(omega: torch.Tensor) -> torch.Tensor:
    x, y, z = omega.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def refinement(iterations: int = 1000, start: int = 100) -> PoseRefinement:
    cameras = ring(3, 1.0)
    views = [SimpleNamespace(name=f"{i}", camera=cameras[i]) for i in range(3)]
    config = PoseConfig(refine=True, lr=1e-2, lr_final=1e-4, start=start)
    return PoseRefinement(config, SimpleNamespace(train=views), iterations)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [0.0, 1e-13, 1e-7, 0.3, 3.0])
def test_a_motion_is_the_exponential_of_its_turn(size: float) -> None:
    omega = size * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    motion = rigid_motion(torch.cat([omega, torch.tensor([1.0, 2, 3], dtype=torch.float64)]))
    torch.testing.assert_close(motion[:3, :3], torch.linalg.matrix_exp(skew(omega)), rtol=0, atol=1e-14)
    assert motion[:3, 3].tolist() == [1, 2, 3]
    assert motion[3].tolist() == [0, 0, 0, 1]


def test_whitened_motions_shift_the_picture_alike() -> None:
    """W is the inverse root of the damped mean of J^T J, J by finite differences; what is at the lens is left out."""
    viewmat = ring(5, 1.0).viewmats[2].double()
    means = 0.5 * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]

    def seen(xi: torch.Tensor) -> torch.Tensor:
        moved = points @ rigid_motion(xi)[:3, :3].T + rigid_motion(xi)[:3, 3]
        return moved[:, :2] / moved[:, 2:]

    units = 1e-6 * torch.eye(6, dtype=torch.float64)
    J = torch.stack([(seen(unit) - seen(-unit)) / 2e-6 for unit in units], dim=2)
    S = torch.einsum("nic,nid->cd", J, J) / len(J)
    W = whitening(viewmat, means)
    torch.testing.assert_close(W @ (S + 0.01 * torch.diag(S.diagonal())) @ W, torch.eye(6).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(W, W.T)
    median = float(points[:, 2].median())
    world = torch.linalg.inv(viewmat)
    for depth, counts in ((0.19 * median, False), (0.25 * median, True)):
        near = world[:3, :3] @ torch.tensor([0.3 * depth, 0, depth], dtype=torch.float64) + world[:3, 3]
        same = torch.allclose(whitening(viewmat, torch.cat([means, near[None]])), W)
        assert same != counts


def test_rates_fall_by_the_same_factor_from_the_first_step_to_the_last() -> None:
    found = refinement()
    assert [found.rate(step) for step in (100, 550, 1000)] == pytest.approx([1e-2, 1e-3, 1e-4])
    assert refinement(iterations=100).rate(100) == pytest.approx(1e-2)


def test_a_pose_takes_adams_steps_in_whitened_motions() -> None:
    found, gaussians = refinement(), cloud(12, seed=3)
    given, random = found.viewmats.clone(), torch.Generator().manual_seed(0)
    u = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([u], lr=1.0, betas=(BETA1, BETA2), eps=1e-15)
    W, expected = whitening(given[1], gaussians.means.double()), given[1].clone()
    for step in (99, 100, 101, 102, 400):
        values = {name: torch.randn(tensor.shape, generator=random) for name, tensor in gaussians.items()}
        gradients = Gradients(**values, means2d=torch.zeros(12, 2), means2d_abs=None)
        v_u = W @ pose_gradient(expected, gaussians, gradients, 1)
        before = u.detach().clone()
        found.update(1, step, gaussians, gradients, 1)
        if step > 100:
            u.grad = v_u
            adam.step()
            expected = rigid_motion(found.rate(step) * W @ (u.detach() - before)) @ expected
        torch.testing.assert_close(found.viewmats[1], expected, rtol=0, atol=1e-9)
    assert torch.equal(found.viewmats[[0, 2]], given[[0, 2]])
    still = Gradients(
        **{name: torch.zeros_like(t) for name, t in gaussians.items()}, means2d=torch.zeros(12, 2), means2d_abs=None
    )
    found.update(0, 500, gaussians, still, 1)
    assert torch.equal(found.viewmats[0], given[0])


def test_a_gaussian_counts_when_its_place_or_its_turn_matters() -> None:
    gaussians = cloud(3, seed=0)
    zero = {name: torch.zeros_like(tensor) for name, tensor in gaussians.items()}
    zero["means"][0, 2], zero["quats"][1, 3], zero["sh0"][2] = 1.0, -1.0, 5.0
    assert poses.seen_rows(Gradients(**zero, means2d=torch.zeros(3, 2), means2d_abs=None)).tolist() == [
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("degrees", [1e-6, 0.5, 30.0, 150.0])
def test_how_far_a_view_went_is_its_turn_and_its_shift(degrees: float) -> None:
    found = refinement()
    omega = math.radians(degrees) * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    world = torch.linalg.inv(found.given[1])
    world[:3, :3] = torch.linalg.matrix_exp(skew(omega)) @ world[:3, :3]
    world[:3, 3] += torch.tensor([3.0, 0, 4], dtype=torch.float64)
    found.viewmats[1] = torch.linalg.inv(world)
    turned, moved = found.moved()
    assert turned.tolist() == pytest.approx([0, degrees, 0], abs=1e-9, rel=1e-6)
    assert moved.tolist() == pytest.approx([0, 5, 0], abs=1e-9)


def test_the_record_is_in_the_frame_of_the_source() -> None:
    """A point of the source is seen where the scene, which was moved by `origin`, sees it."""
    found = refinement()
    record = found.record((10.0, -20.0, 30.0))
    assert record["version"] == 1
    point = torch.tensor([10.5, -19.0, 30.25, 1], dtype=torch.float64)
    shifted = torch.tensor([0.5, 1.0, 0.25, 1], dtype=torch.float64)
    for i, view in enumerate(record["views"]):
        seen = torch.tensor(view["cam_from_world"], dtype=torch.float64) @ point
        torch.testing.assert_close(seen, found.viewmats[i] @ shifted)
        assert (view["name"], view["turned_degrees"], view["moved"]) == (f"{i}", 0.0, 0.0)
    assert torch.equal(found.viewmats, found.given)


def test_a_state_of_another_shape_is_refused() -> None:
    found = refinement()
    state = {name: tensor.clone() for name, tensor in found.tensors().items()}
    state["viewmats"][0, 0, 3] = 7
    found.restore(state)
    assert found.viewmats[0, 0, 3] == 7
    with pytest.raises(ValueError, match=r"the shape of poses\.exp_avg"):
        found.restore({**state, "exp_avg": torch.zeros(2, 6)})


def test_a_camera_stands_where_its_pose_was_learned() -> None:
    found = refinement()
    found.viewmats[1, 1, 3] += 1
    camera = ring(3, 1.0)[1]
    assert torch.equal(found.camera(1, camera).viewmats, found.viewmats[1][None].to(camera.viewmats))
    assert found.camera(1, camera).viewmats.dtype == camera.viewmats.dtype
