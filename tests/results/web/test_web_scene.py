"""What a page opens with: the lens around the splats, the camera of bare splats, and the numbers that it is told."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.results.web.scene import framed, numbers, pose, scene_of_splats, spread

K = torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]])
CAMERA = Cameras(torch.eye(4)[None], K, 100, 100)


def at_pixels(pixels: list[tuple[float, float]], opacity: float = 0.9, depth: float = 2.0) -> Gaussians:
    """A splat at each pixel of the camera."""
    means = torch.tensor([[(x - 50) / 100 * depth, (y - 50) / 100 * depth, depth] for x, y in pixels])
    count = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.zeros(count, 3),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )


CORNERS = [(30.0, 40.0), (70.0, 60.0)]


def shown(gaussians: Gaussians, x: float, y: float) -> list[float]:
    """Where the framed camera shows what the camera shows at a pixel."""
    ray = torch.linalg.solve(K[0], torch.tensor([x, y, 1.0]))
    return (framed(gaussians, CAMERA).Ks[0] @ ray)[:2].tolist()


def test_the_splats_fill_92_percent_of_the_tighter_side_around_the_middle() -> None:
    """40 of 100 px become 92: magnified by 2.3."""
    splats = at_pixels(CORNERS)
    assert shown(splats, 30, 40) == pytest.approx([4, 27], abs=1e-3)
    assert shown(splats, 70, 60) == pytest.approx([96, 73], abs=1e-3)
    tall = at_pixels([(y, x + 10) for x, y in CORNERS])
    assert shown(tall, 40, 40) == pytest.approx([27, 4], abs=1e-3)


def test_a_few_splats_are_magnified_three_times_at_most_and_wide_ones_not() -> None:
    assert shown(at_pixels([(20.0, 20.0), (21.0, 21.0)]), 20, 20) == pytest.approx([48.5, 48.5], abs=1e-3)
    assert shown(at_pixels([(20.0, 20.0), (20.0, 20.0)]), 20, 20) == pytest.approx([50, 50], abs=1e-3)
    assert framed(at_pixels([(0.0, 50.0), (100.0, 50.0)]), CAMERA) is CAMERA
    assert framed(at_pixels(CORNERS[:1]), CAMERA) is CAMERA


@pytest.mark.parametrize(("outliers", "counted"), [(2, False), (3, True)])
def test_two_in_a_thousand_splats_on_each_side_do_not_count(outliers: int, counted: bool) -> None:
    pixels = CORNERS * ((1000 - 2 * outliers) // 2) + [(1.0, 50.0), (99.0, 50.0)] * outliers
    assert len(pixels) == 1000
    assert (shown(at_pixels(pixels), 30, 40) != pytest.approx([4, 27], abs=1e-3)) == counted


def test_faint_splats_and_those_outside_or_behind_do_not_count() -> None:
    splats = at_pixels(CORNERS)
    for other, counts in (
        (at_pixels([(1.0, 1.0)], opacity=0.09), False),
        (at_pixels([(1.0, 1.0)], opacity=0.11), True),
        (at_pixels([(-1.0, 50.0), (101.0, 50.0)]), False),
        (at_pixels([(1.0, 1.0)], depth=-2.0), False),
    ):
        assert (shown(splats.append(other), 30, 40) != pytest.approx([4, 27], abs=1e-3)) == counts


def test_numbers_have_seven_digits() -> None:
    assert numbers(torch.tensor([1 / 3, 12345678.9, 0.0], dtype=torch.float64)) == [0.3333333, 12345680.0, 0.0]


def test_a_pose_has_eye_axes_and_lens_in_the_viewers_order() -> None:
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-1.0, -2, -3])
    lens = torch.tensor([[[10.0, 0, 3], [0, 20, 4], [0, 0, 1]]])
    found = pose(Cameras(viewmat[None], lens, 6, 8))
    assert found == {"eye": [1, 2, 3], "axes": [1, 0, 0, 0, 1, 0, 0, 0, 1], "lens": [10, 20, 3, 4, 6, 8]}


@pytest.mark.parametrize(("count", "step"), [(0, 1), (1, 1), (200, 1), (201, 2), (400, 2), (401, 3)])
def test_at_most_two_hundred_views_are_drawn_evenly(count: int, step: int) -> None:
    views = [(str(number), CAMERA) for number in range(count)]
    assert [name for name, _ in spread(views)] == [str(number) for number in range(0, count, step)]


def test_bare_splats_are_seen_from_the_front_of_their_solid_middle() -> None:
    """Nine of ten solid splats lie within 1 of the median; the eye is 2.6 of this away, at a lens of 1.1 widths."""
    places = [(5.0 + x, 6.0, 7.0) for x in (0.0, 0.0, 0.5, -0.5, 0.5, -0.5, 1.0, -1.0, 1.0, -1.0, 9.0)]
    splats = replace(at_pixels([(0.0, 0.0)] * 11), means=torch.tensor(places))
    faint = replace(at_pixels([(0.0, 0.0)] * 5, opacity=0.1), means=torch.full((5, 3), 500.0))
    scene = scene_of_splats(splats.append(faint), "a")
    assert scene.target.tolist() == [5, 6, 7]
    assert scene.home.centers[0].tolist() == pytest.approx([5, 6, 7 - 2.6])
    assert pose(scene.home)["lens"] == pytest.approx([880, 880, 400, 400, 800, 800])
    assert scene.up.tolist() == [0, -1, 0]
    assert scene.background == (0, 0, 0)
    assert (scene.inputs, scene.path, scene.antialiased) == (0, None, False)
    told = scene.to_json()
    assert told["cameraSize"] == pytest.approx(0.06 * 2.6)
    assert told["path"] == []
    assert told["pathSeconds"] == 20
    assert scene_of_splats(splats.select(torch.zeros(11, dtype=torch.bool)), "b").target.tolist() == [0, 0, 0]
