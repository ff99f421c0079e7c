"""Candidate cameras against formulas of their own: rings, places, words for sides, middle squares."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_coverage_and_views import INPUTS, camera

from gsopt.geometry.cameras import Cameras
from gsopt.sds import candidate_views
from gsopt.sds.candidate_views import draw_candidate, guidance_cameras, nearest, ring_angles, square, square_views
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import References

DEGREES = math.pi / 180


@given(st.floats(-math.pi / 2, math.pi / 2))
def test_three_rings_lie_25_degrees_apart_between_20_below_and_75_above(mean: float) -> None:
    angles = ring_angles(mean)
    assert angles.shape == (36, 2)
    for ring in range(3):
        elevation = mean + (ring - 1) * 25 * DEGREES
        expected = min(max(elevation, -20 * DEGREES), 75 * DEGREES)
        rows = angles[12 * ring : 12 * ring + 12]
        assert rows[:, 1].tolist() == pytest.approx([expected] * 12)
        assert rows[:, 0].tolist() == pytest.approx([(30 * i + 10 * (ring - 1)) * DEGREES for i in range(12)])


def test_a_camera_is_placed_by_azimuth_from_the_front_and_elevation() -> None:
    """Inputs at 20 degrees of elevation, the front at 30 degrees of azimuth, 4 units away from the origin."""
    found = guidance_cameras(INPUTS, 2.0, 32, camera(30, 20))
    angles = torch.tensor([[0.0, 0.0], [40.0, 10.0], [-100.0, 60.0]], dtype=torch.float64) * DEGREES
    for i, (azimuth, elevation) in enumerate(((30, 0), (70, 10), (-70, 60))):
        placed = found.placed(angles)[i]
        torch.testing.assert_close(placed.centers, camera(azimuth, elevation).centers, atol=2e-2, rtol=0)
        torch.testing.assert_close(placed.forwards, camera(azimuth, elevation).forwards, atol=5e-3, rtol=0)
    assert found.distance == pytest.approx(4, abs=1e-2)
    assert found.focus.norm() < 2e-2
    assert found.candidates.centers[12:24, 2].tolist() == pytest.approx([4 * math.sin(20 * DEGREES)] * 12, abs=2e-2)
    assert (found.candidates[0].Ks[0] - found.K).abs().max() < 1e-6


def test_everything_moves_with_the_subject() -> None:
    """What is told of cameras far from the origin is what is told of the same ones around it."""
    by = torch.tensor([5.0, -3.0, 2.0])

    def moved(one: Cameras) -> Cameras:
        viewmats = one.viewmats.clone()
        viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ by
        return replace(one, viewmats=viewmats)

    here = guidance_cameras(INPUTS, 2.0, 32, camera(30, 20))
    there = guidance_cameras([moved(one) for one in INPUTS], 2.0, 32, moved(camera(30, 20)))
    torch.testing.assert_close(there.focus - here.focus, by.double(), atol=1e-4, rtol=0)
    torch.testing.assert_close(there.ahead, here.ahead, atol=1e-4, rtol=0)
    assert here.angles is not None
    torch.testing.assert_close(there.angles, here.angles, atol=1e-4, rtol=0)
    assert there.distance == pytest.approx(here.distance, abs=1e-4)
    for azimuth, elevation in ((30, 0), (120, 10), (210, 20), (0, 80)):
        one = camera(azimuth, elevation)
        assert there.side(moved(one), True) == here.side(one, True)


def test_the_distance_is_the_median_and_the_view_the_narrowest() -> None:
    inputs = [camera(0, 20, 3.0), camera(40, 20, 4.0), camera(80, 20, 9.0, width=96), camera(-40, 20, 4.0)]
    inputs[1].Ks[0, 0, 0] *= 2
    found = guidance_cameras(inputs, 2.0, 32, inputs[0])
    assert found.distance == pytest.approx(4, abs=0.05)
    assert float(found.K[0, 0]) == pytest.approx(float(inputs[1].Ks[0, 0, 0]) / 2, rel=1e-6)


def test_a_drawn_camera_is_moved_by_15_degrees_around_and_8_up_or_down_at_most() -> None:
    found = guidance_cameras(INPUTS, 2.0, 32, INPUTS[0])
    assert found.angles is not None
    shifts = []
    for step in range(300):
        moved = found._angles_of(found.camera(14, generator(0, step, 0, "jitter")))
        shifts.append([a - b for a, b in zip(moved, found.angles[14].tolist(), strict=True)])
    azimuths, elevations = zip(*shifts, strict=True)
    for values, most in ((azimuths, 15), (elevations, 8)):
        assert -most * DEGREES <= min(values) < -0.95 * most * DEGREES
        assert 0.95 * most * DEGREES < max(values) <= most * DEGREES
    found.angles[14, 1] = 70 * DEGREES
    highest = max(found._angles_of(found.camera(14, generator(0, step, 0, "jitter")))[1] for step in range(50))
    assert highest == pytest.approx(75 * DEGREES, abs=1e-3)
    assert torch.equal(found.camera(14).viewmats, found.candidates[14].viewmats)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "side"),
    [
        (44.9, 0, "front"),
        (-44.9, 0, "front"),
        (45.1, 0, "side"),
        (134.9, 0, "side"),
        (-135.1, 0, "back"),
        (135.1, 0, "back"),
        (0, 59.9, "front"),
        (0, 60.1, "top"),
        (180, -80, "back"),
    ],
)
def test_the_words_for_sides_change_at_45_135_and_60_degrees(azimuth: float, elevation: float, side: str) -> None:
    found = guidance_cameras(INPUTS, 2.0, 32, camera(0, 20))
    exact = candidate_views.replace(
        found, focus=torch.zeros(3, dtype=torch.float64), up=torch.tensor([0.0, 0, 1]).double()
    )
    exact = candidate_views.replace(exact, ahead=torch.tensor([1.0, 0, 0], dtype=torch.float64))
    assert exact.side(camera(azimuth, elevation), front_known=True) == side


def test_a_camera_straight_above_has_some_front() -> None:
    up = torch.tensor([0.0, 0, 2], dtype=torch.float64) / 2
    for direction in (torch.tensor([0.0, 0, 5]).double(), torch.zeros(3).double()):
        level = candidate_views._level(direction, up)
        assert float(level.norm()) == pytest.approx(1)
        assert float(level @ up) == 0
    found = candidate_views._level(torch.tensor([3.0, 4, 9], dtype=torch.float64), up)
    assert found.tolist() == pytest.approx([0.6, 0.8, 0])
    slight = candidate_views._level(torch.tensor([2e-6, 0, 1], dtype=torch.float64), up)
    assert slight.tolist() == pytest.approx([1, 0, 0])


@pytest.mark.parametrize(("width", "height"), [(9, 6), (6, 9), (8, 5), (7, 7)])
def test_the_middle_square_shows_what_the_image_shows_there(width: int, height: int) -> None:
    """A ray through a pixel of the whole image meets the same pixel of the square, moved by the cut."""
    whole = camera(0, 20, width=width, height=height)
    side = min(width, height)
    cut = square(whole, 2 * side)
    assert (cut.width, cut.height) == (2 * side, 2 * side)
    expected = whole.Ks[0].clone()
    expected[0, 2] -= (width - side) // 2
    expected[1, 2] -= (height - side) // 2
    torch.testing.assert_close(cut.Ks[0], expected * torch.tensor([2.0, 2, 1])[:, None])
    assert torch.equal(cut.viewmats, whole.viewmats)


@pytest.mark.parametrize("channels", [3, 4])
def test_square_views_are_their_middle_on_the_background(channels: int) -> None:
    pixels = torch.randint(0, 256, (5, 9, channels), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    view: Any = SimpleNamespace(pixels=lambda: pixels, camera=camera(0, 20, width=9, height=5))
    background = torch.tensor([0.2, 0.4, 0.6])
    found = square_views([view], 5, background)
    middle = pixels[:, 2:7].permute(2, 0, 1).float() / 255
    alpha = middle[3:] if channels == 4 else torch.ones_like(middle[:1])
    torch.testing.assert_close(found.alphas[0], alpha)
    torch.testing.assert_close(found.images[0], middle[:3] * alpha + (1 - alpha) * background[:, None, None])
    assert found.cameras.width == 5


def test_uncertainty_at_the_least_counts() -> None:
    exact = torch.tensor([0.25, 0.0], dtype=torch.float32)
    assert draw_candidate(exact, 0.25, generator(0, 0, 0, "camera")) == 0
    assert draw_candidate(exact, 0.2501, generator(0, 0, 0, "camera")) is None


def test_nothing_is_near_where_there_is_no_reference_and_depths_come_along() -> None:
    cameras = Cameras.cat([square(camera(a), 8) for a in (0, 90)])
    depths = torch.arange(2.0)[:, None, None, None].expand(2, 1, 8, 8)
    references = References(torch.zeros(2, 3, 8, 8), torch.ones(2, 1, 8, 8), cameras, depths)
    found = nearest(references, camera(80), 1)
    assert found is not None
    assert found.depths is not None
    assert found.depths.unique().tolist() == [1.0]
    empty = Cameras(cameras.viewmats[:0], cameras.Ks[:0], 8, 8)
    assert nearest(References(torch.zeros(0, 3, 8, 8), torch.ones(0, 1, 8, 8), empty), camera(80), 1) is None


@pytest.mark.parametrize(("height", "width"), [(48, 24), (24, 48)])
def test_the_picture_shows_the_middle_square_that_its_camera_sees(height: int, width: int) -> None:
    """Of 48 px the 12 at either end are cut: a picture that is white in the middle alone becomes white."""
    pixels = torch.zeros(height, width, 3, dtype=torch.uint8)
    pixels[(height - 24) // 2 : (height + 24) // 2, (width - 24) // 2 : (width + 24) // 2] = 255
    view: Any = SimpleNamespace(pixels=lambda: pixels, camera=camera(0, 0, width=width, height=height))
    assert float(square_views([view], 24, torch.zeros(3)).images.min()) == 1
