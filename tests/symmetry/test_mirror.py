"""A mirror, and the camera behind it."""

from __future__ import annotations

import math

import torch
from balls import ring
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import project
from gsopt.symmetry.mirror import Mirror

numbers = st.floats(-1, 1, width=32)


def mirror_of(x: float, y: float, z: float, offset: float) -> Mirror:
    return Mirror(torch.nn.functional.normalize(torch.tensor([x, y, z + 2]), dim=0), offset)


def random_points(count: int = 50) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5


@settings(max_examples=25, deadline=None)
@given(numbers, numbers, numbers, numbers)
def test_reflecting_twice_is_nothing_and_keeps_lengths(x: float, y: float, z: float, offset: float) -> None:
    mirror, points = mirror_of(x, y, z, offset), random_points()
    images = mirror.reflect(points)
    assert torch.allclose(mirror.reflect(images), points, atol=2e-6)
    apart, before = (there[:, None] - there for there in (images, points))
    assert torch.allclose(apart.norm(dim=-1), before.norm(dim=-1), atol=1e-5)
    assert torch.allclose(mirror.distance(images), -mirror.distance(points), atol=2e-6)
    middle = (points + images) / 2
    assert torch.allclose(mirror.distance(middle), torch.zeros(len(points)), atol=2e-6)


@settings(max_examples=25, deadline=None)
@given(numbers, numbers, numbers, numbers)
def test_the_camera_behind_the_mirror_sees_the_picture_flipped(x: float, y: float, z: float, offset: float) -> None:
    mirror, points = mirror_of(x, y, z, offset), random_points()
    camera = ring(3)[1]
    off_center = camera.Ks.clone()
    off_center[:, 0, 2] += 7.5
    camera = Cameras(camera.viewmats, off_center, 96, 80)
    behind = mirror.camera(camera)
    column, row, depth = project(camera, points.double())
    flipped, same_row, same_depth = project(behind, mirror.reflect(points).double())
    assert torch.allclose(flipped, camera.width - column, atol=1e-3)
    assert torch.allclose(same_row, row, atol=1e-3)
    assert torch.allclose(same_depth, depth, atol=1e-5)


def test_the_camera_behind_the_mirror_is_a_camera() -> None:
    viewmat = mirror_of(0.3, -0.5, 0.2, 0.4).camera(ring(4)[2]).viewmats[0]
    R = viewmat[:3, :3]
    assert torch.allclose(R @ R.T, torch.eye(3).double(), atol=1e-6)
    assert float(torch.linalg.det(R)) > 0.999
    assert viewmat[3].tolist() == [0, 0, 0, 1]


def test_a_mirror_turns_about_a_center_and_moves_from_it_by_a_share_of_the_radius() -> None:
    mirror, center = mirror_of(0.3, -0.5, 0.2, 0.4), torch.tensor([1.0, -2.0, 0.5])
    for change in ([0.0, 0.0, 0.0], [0.01, 0.0, 0.1], [0.0, 0.02, -0.3], [0.03, -0.04, 0.2]):
        moved = mirror.moved(torch.tensor(change), center, 5.0)
        away = float(mirror.distance(center)) - 5 * change[2]
        assert abs(float(moved.distance(center)) - away) < 1e-5
        turned = torch.linalg.cross(mirror.normal, moved.normal).norm()
        assert abs(float(turned) - math.sin(math.atan(math.hypot(*change[:2])))) < 1e-5
    assert mirror.freedom == 3
