"""The point that cameras look at."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.focus import AXIS_DAMPING, find_focus, nearest_to_axes

UP = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)
EYES = 4 * torch.nn.functional.normalize(
    torch.tensor([[1.0, 0, 0], [0, 1, 1], [-1, 0.1, 0], [0.1, -1, -1], [1, 1, 1]], dtype=torch.float64)
)


def cameras_at(eyes: Tensor, target: Tensor) -> list[Cameras]:
    K = intrinsics(0.7, 64, 64)[None]
    return [Cameras(look_at(eye[None], target, UP), K, 64, 64) for eye in eyes]


def test_the_focus_is_where_the_axes_meet() -> None:
    target = torch.tensor([2.0, -1.0, 3.0], dtype=torch.float64)
    focus = find_focus(cameras_at(EYES + target, target), 4.0)
    assert focus.converging
    assert torch.allclose(focus.point.double(), target, atol=1e-4)
    assert focus.distance == pytest.approx(4.0, abs=1e-4)
    assert focus.radius == pytest.approx(4 * math.tan(0.35), rel=1e-4)


def test_two_cameras_that_face_each_other_and_a_lone_one_look_at_the_origin() -> None:
    origin = torch.zeros(3, dtype=torch.float64)
    for rows in ([0, 2], [0]):
        cameras = [camera.to(torch.float32) for camera in cameras_at(EYES[rows], origin)]
        assert float(find_focus(cameras, 1.0).point.norm()) < 0.1


@pytest.mark.parametrize(("degrees", "damping", "far"), [(1.0, AXIS_DAMPING, True), (1.0, 1e-3, False)])
def test_damping_decides_below_its_square_root_in_radians(degrees: float, damping: float, far: bool) -> None:
    half = math.radians(degrees) / 2
    centers = torch.tensor([[0.0, -1, 0], [0, 1, 0]], dtype=torch.float64)
    axes = torch.tensor([[math.cos(half), math.sin(half), 0], [math.cos(half), -math.sin(half), 0]]).double()
    ahead = float(nearest_to_axes(centers, axes, damping)[0]) * math.tan(half)
    assert (ahead > 0.9) == far
    assert far or ahead < 0.1
