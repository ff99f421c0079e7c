"""Camera paths: what they go around, how they look at it, and that they move with the world."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsopt.errors import InputError
from gsopt.geometry.camera_paths import (
    ellipse_path,
    focus_point,
    interpolated_path,
    orbit_path,
    turntable_path,
)
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.focus import up_direction

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
TILT = 1e-3
"""Most that the damping tilts the up direction, radians."""
TARGET = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)


def cameras_at(eyes: Tensor, target: Tensor = TARGET) -> Cameras:
    K = intrinsics(0.7, 32, 24).repeat(len(eyes), 1, 1)
    return Cameras(look_at(eyes, target, UP), K, 32, 24)


def on_ring(azimuths: Tensor, radius: float, height: float) -> Tensor:
    ring = torch.stack([radius * azimuths.cos(), radius * azimuths.sin(), torch.full_like(azimuths, height)], dim=1)
    return TARGET + ring


@pytest.fixture
def ring() -> Cameras:
    return cameras_at(on_ring(torch.tensor([0.2, 1.1, 2.9, 4.4], dtype=torch.float64), 3.0, 2.0))


@pytest.fixture
def one_sided() -> Cameras:
    """Three cameras that look down from one side: their mean up leans."""
    return cameras_at(on_ring(torch.tensor([0.0, 0.3, 0.6], dtype=torch.float64), 3.0, 2.0))


def moved(cameras: Cameras, R: Tensor, t: Tensor, scale: float) -> Cameras:
    """The cameras in a world where x' = scale R x + t."""
    eyes = scale * cameras.centers @ R.T + t
    turned = cameras.viewmats.clone()
    turned[:, :3, :3] = cameras.viewmats[:, :3, :3] @ R.T
    turned[:, :3, 3] = -(turned[:, :3, :3] @ eyes[..., None])[..., 0]
    return Cameras(turned, cameras.Ks, cameras.width, cameras.height)


def test_the_focus_is_where_the_axes_meet(ring: Cameras, one_sided: Cameras) -> None:
    # The pull towards the cameras moves it by about FOCUS_DAMPING of their distance.
    torch.testing.assert_close(focus_point(ring), TARGET, atol=0.01, rtol=0)
    assert (focus_point(one_sided) - TARGET).norm() < 0.1


def test_parallel_axes_and_single_cameras_have_a_finite_focus() -> None:
    eyes = torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64)
    parallel = Cameras(torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), intrinsics(0.7, 8, 8).repeat(2, 1, 1), 8, 8)
    parallel.viewmats[:, :3, 3] = -eyes
    for cameras in (parallel, parallel[0]):
        assert torch.isfinite(focus_point(cameras)).all()
        assert torch.isfinite(orbit_path(cameras, 3).viewmats).all()


def test_up_is_the_worlds_even_from_one_side(ring: Cameras, one_sided: Cameras) -> None:
    torch.testing.assert_close(up_direction(ring.viewmats), UP, atol=TILT, rtol=0)
    mean_up = torch.nn.functional.normalize(-one_sided.viewmats[:, 1, :3].mean(0), dim=0)
    assert mean_up @ UP < 0.9
    assert up_direction(one_sided.viewmats) @ UP > 0.999


@pytest.mark.parametrize("path", [orbit_path, turntable_path, ellipse_path])
def test_a_path_looks_at_its_focus_upright_from_a_constant_height(path, ring: Cameras) -> None:
    film = path(ring, 12, TARGET)
    assert (len(film), film.width, film.height) == (12, 32, 24)
    to_focus = torch.nn.functional.normalize(TARGET - film.centers, dim=1)
    torch.testing.assert_close(film.forwards, to_focus, atol=1e-9, rtol=0)
    assert (film.viewmats[:, 0, :3] @ up_direction(ring.viewmats)).abs().max() < 1e-9
    height = (film.centers - TARGET) @ up_direction(ring.viewmats)
    torch.testing.assert_close(height, height[:1].expand(12), atol=1e-9, rtol=0)


def test_an_orbit_of_cameras_on_a_circle_is_that_circle_from_the_first_camera_on(ring: Cameras) -> None:
    film = orbit_path(ring, 10, TARGET)
    torch.testing.assert_close(film.viewmats[0], ring.viewmats[0], atol=TILT, rtol=0)
    distance = (film.centers - TARGET).norm(dim=1)
    torch.testing.assert_close(distance, torch.full_like(distance, math.hypot(3, 2)), atol=1e-6, rtol=0)
    step = (film.centers - film.centers.roll(1, 0)).norm(dim=1)
    torch.testing.assert_close(step, step[:1].expand(10), atol=1e-6, rtol=0)


def test_a_turntable_goes_all_around_only_where_the_cameras_stood_all_around(ring: Cameras) -> None:
    torch.testing.assert_close(turntable_path(ring, 9, TARGET).viewmats, orbit_path(ring, 9, TARGET).viewmats)


@pytest.mark.parametrize("azimuths", [[0.0, 0.3, 0.6], [2.9, 3.6, 3.0], [0.1, 2 * math.pi - 0.5]])
def test_a_turntable_swings_between_the_outermost_cameras_of_one_side(azimuths: list[float]) -> None:
    """Also across the place where azimuths jump from a turn to zero."""
    eyes = on_ring(torch.tensor(azimuths, dtype=torch.float64), 3.0, 2.0)
    film = turntable_path(cameras_at(eyes), 16, TARGET)
    reached = torch.cdist(eyes, film.centers).min(dim=1).values
    outermost = torch.cdist(eyes, eyes).max(dim=1).values.topk(2).indices
    assert reached[outermost].max() < 0.01
    assert torch.cdist(film.centers, film.centers).max() < torch.cdist(eyes, eyes).max() + 0.01


def test_a_turntable_of_one_camera_still_moves(ring: Cameras) -> None:
    film = turntable_path(ring[0], 8, TARGET)
    assert 0.5 < torch.cdist(film.centers, film.centers).max() < 3


def test_an_ellipse_follows_a_longish_capture_in_equal_steps() -> None:
    azimuths = torch.linspace(0, 2 * math.pi, 41, dtype=torch.float64)[:-1]
    eyes = TARGET + torch.stack([4 * azimuths.cos(), 2 * azimuths.sin(), torch.ones_like(azimuths)], dim=1)
    film = ellipse_path(cameras_at(eyes), 24, TARGET)
    reach = (film.centers - TARGET).abs().amax(0)
    assert 3.5 < reach[0] <= 4.01
    assert 1.7 < reach[1] <= 2.01
    steps = (film.centers - film.centers.roll(1, 0)).norm(dim=1)
    assert steps.max() / steps.min() < 1.05


def test_an_ellipse_of_cameras_in_a_row_still_goes_around() -> None:
    eyes = torch.tensor([[-2.0, -4, 1], [0, -4, 1], [2, -4, 1]], dtype=torch.float64)
    film = ellipse_path(cameras_at(eyes, torch.zeros(3, dtype=torch.float64)), 16)
    assert film.centers[:, 1].max() > 0.5
    assert film.centers.norm(dim=1).min() > 0.5


def test_an_interpolated_path_passes_every_camera(ring: Cameras) -> None:
    film = interpolated_path(ring, 3 * 5 + 1)
    torch.testing.assert_close(film.viewmats[::5], ring.viewmats, atol=1e-9, rtol=0)
    torch.testing.assert_close(film.Ks[::5], ring.Ks)
    R = film.viewmats[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), atol=1e-9, rtol=0)
    assert (torch.linalg.det(R) > 0).all()


def test_photos_of_another_shape_fill_the_frame_of_the_first_and_are_not_stretched() -> None:
    """A landscape frame shows the full width of a portrait and cuts off what lies above and below."""

    def camera(width: int, height: int) -> Cameras:
        K = torch.tensor([[50.0, 0, 0.5 * width + 3], [0, 52, 0.5 * height - 4], [0, 0, 1]], dtype=torch.float64)
        return Cameras(torch.eye(4, dtype=torch.float64)[None], K[None], width, height)

    wide, tall, small = camera(60, 40), camera(40, 60), camera(30, 20)
    batch = Cameras.of_one_size([wide, tall, small])
    assert (batch.width, batch.height) == (60, 40)
    assert torch.equal(batch.Ks[0], wide.Ks[0])
    scaled = [[75.0, 0, 1.5 * 23], [0, 78, 1.5 * 26 - (90 - 40) / 2], [0, 0, 1]]
    torch.testing.assert_close(batch.Ks[1], torch.tensor(scaled, dtype=torch.float64))
    torch.testing.assert_close(batch.Ks[2], small.resized(60, 40).Ks[0])
    turned = Cameras.of_one_size([tall, wide]).Ks[1]
    torch.testing.assert_close(turned[:2, 2], torch.tensor([1.5 * 33 - (90 - 40) / 2, 1.5 * 16], dtype=torch.float64))
    assert torch.equal(tall.Ks, camera(40, 60).Ks)


def test_an_interpolated_path_of_one_camera_stays_there(ring: Cameras) -> None:
    film = interpolated_path(ring[0], 3)
    torch.testing.assert_close(film.viewmats, ring.viewmats[:1].expand(3, 4, 4), atol=1e-9, rtol=0)


@pytest.mark.parametrize("path", [orbit_path, turntable_path, ellipse_path, interpolated_path])
def test_a_path_moves_with_the_world(path, ring: Cameras) -> None:
    """Similar worlds have similar films: rotation, translation and scale go straight through."""
    axis = torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.9], [-0.2, 0.9, 0]], dtype=torch.float64)
    R, t, scale = torch.matrix_exp(axis), torch.tensor([5.0, -2, 1], dtype=torch.float64), 2.5
    expected = moved(path(ring, 7), R, t, scale)
    torch.testing.assert_close(path(moved(ring, R, t, scale), 7).viewmats, expected.viewmats, atol=1e-6, rtol=0)


def test_no_cameras_make_no_path(ring: Cameras) -> None:
    for path in (orbit_path, turntable_path, ellipse_path, interpolated_path):
        with pytest.raises(InputError, match="got 0"):
            path(ring[:0], 3)
