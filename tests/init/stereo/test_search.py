"""Images, planes and the search for them: sizes, rays, how far a good plane spreads, and how large the steps are."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import project
from gsopt.init.stereo.agreement import _angles, _confirmations
from gsopt.init.stereo.image import StereoImage
from gsopt.init.stereo.points import nearest
from gsopt.init.stereo.search import PlaneMap, Reach, Search, at, random_planes
from gsopt.init.thumbnails import Thumbnail


def image(width: int = 40, height: int = 30, focal: float = 50.0, x: float = 0.0, z: float = 0.0) -> StereoImage:
    """Seen from (x, 0, z) along the z axis."""
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([-x, 0, -z])
    return StereoImage(Cameras(viewmat[None], K, width, height), torch.zeros(3, height, width))


@pytest.mark.parametrize(
    ("size", "pixels", "expected"),
    [((400, 200), 8000, (128, 63)), ((40, 30), 10**9, (40, 30)), ((5, 5), 10**9, (8, 8)), ((90, 40), 900, (48, 20))],
)
def test_an_image_has_about_so_many_pixels_and_a_width_of_eights(
    size: tuple[int, int], pixels: int, expected: tuple[int, int]
) -> None:
    K = torch.tensor([[[100.0, 0, size[0] / 2], [0, 100, size[1] / 2], [0, 0, 1]]])
    planes = torch.full((4, size[1], size[0]), 51, dtype=torch.uint8)
    found = StereoImage.of(Thumbnail(Cameras(torch.eye(4)[None], K, *size), planes), pixels)
    assert (found.camera.width, found.camera.height) == expected
    assert found.rgb.shape == (3, expected[1], expected[0])
    torch.testing.assert_close(found.rgb, torch.full_like(found.rgb, 0.2))


def test_brightness_is_that_of_recommendation_601() -> None:
    colors = torch.tensor([[1.0, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])[:, None]
    found = StereoImage(image(4, 1).camera, colors).gray
    torch.testing.assert_close(found, torch.tensor([[0.299, 0.587, 0.114, 1.0]]))


def test_points_of_pixels_project_to_their_centers_at_their_depths() -> None:
    one = image(x=0.3, z=-2.0)
    assert one.pixels[:, 0, 0].tolist() == [0.5, 0.5]
    assert one.pixels[:, 29, 39].tolist() == [39.5, 29.5]
    inverse = torch.rand(30, 40, generator=torch.Generator().manual_seed(0)) + 0.1
    column, row, depth = project(one.camera, one.points(inverse).view(-1, 3))
    torch.testing.assert_close(torch.stack([column, row]).view(2, 30, 40), one.pixels, atol=1e-3, rtol=0)
    torch.testing.assert_close(depth.view(30, 40), 1 / inverse, rtol=1e-4, atol=0)


def test_random_planes_are_uniform_in_inverse_depth_and_tilted_in_proportion() -> None:
    one = image(200, 200)
    planes = random_planes(one, Reach(0.5, 2.5), torch.Generator().manual_seed(0))
    inverse = at(planes, one.rays)
    ranks = ((inverse.flatten() - 0.5) / 2).sort().values
    torch.testing.assert_close(ranks, torch.linspace(0, 1, 40_000), atol=0.015, rtol=0)
    slopes = planes[:2] / inverse
    assert float(slopes.mean()) == pytest.approx(0, abs=0.02)
    assert float(slopes.std()) == pytest.approx(1, abs=0.02)


class Wanted:
    """Stands for the matcher: the cost is the distance of the inverse depth from one, at three sources."""

    def __init__(self, rays: Tensor, wanted: float, extra: tuple[float, ...] = (0.5, 0.0, 0.25)) -> None:
        self.rays, self.wanted, self.extra = rays, wanted, extra
        self.asked: list[Tensor] = []

    def costs(self, planes: Tensor) -> Tensor:
        self.asked.append(planes)
        cost = (at(planes, self.rays) - self.wanted).abs()
        return torch.stack([cost + more for more in self.extra])


def search(one: StereoImage, planes: Tensor, wanted: float = 1.0) -> tuple[Search, Any]:
    matcher = Wanted(one.rays, wanted)
    return Search(one, matcher, Reach(0.5, 2.5), planes), matcher  # type: ignore[arg-type]


@pytest.mark.parametrize(("rounds", "reach"), [(1, 8), (2, 14), (3, 18), (4, 21), (5, 23)])
def test_a_good_plane_spreads_by_one_pixel_and_by_a_shrinking_ring(rounds: int, reach: int) -> None:
    """By 1 + 7, 1 + 5, 1 + 3, 1 + 2 and 1 + 1 pixels in the first five rounds, along rows and columns."""
    one = image(64, 64)
    planes = torch.zeros(3, 64, 64)
    planes[2] = 2.0
    planes[2, 30, 32] = 1.0
    found = search(one, planes)[0].run(rounds, 0.0, torch.Generator())
    good = found.costs == 0
    rows, columns = good.any(1).nonzero()[:, 0], good.any(0).nonzero()[:, 0]
    assert (int(rows[0]), int(rows[-1])) == (30 - reach, 30 + reach)
    assert (int(columns[0]), int(columns[-1])) == (32 - reach, 32 + reach)
    if rounds == 1:
        assert int(good.sum()) == 81, "nine by nine: each at -8 to 8 by ones and sevens"


def test_the_best_source_counts_and_planes_out_of_reach_are_forbidden() -> None:
    one = image(8, 8)
    planes = torch.zeros(3, 8, 8)
    planes[2] = 1.25
    planes[2, 0, :4] = torch.tensor([0.5, 2.5, 0.51, 2.49])
    costs = search(one, planes)[0].run(0, 0.0, torch.Generator()).costs
    assert costs[0, :5].tolist() == pytest.approx([9, 9, 0.49, 1.49, 0.25], abs=1e-6)


def test_steps_of_the_depth_are_three_tenths_of_the_range_and_a_fifth_of_it_and_halve_every_round() -> None:
    one = image(64, 64)
    planes = torch.zeros(3, 64, 64)
    planes[2] = 1.0  # is the best already: every step starts from it
    found, matcher = search(one, planes)
    found.run(3, 1.0, torch.Generator().manual_seed(0))
    shaken = [matcher.asked[1 + 10 * turn + 8 + which] for turn in range(3) for which in range(2)]
    steps = [float((at(each, one.rays) - 1).std()) for each in shaken]
    assert steps == pytest.approx([0.6, 0.12, 0.3, 0.06, 0.15, 0.03], rel=0.05)
    tilts = [float(each[:2].std()) for each in shaken]
    assert tilts == pytest.approx([1, 1, 0.5, 0.5, 0, 0.25], rel=0.05)


def test_a_larger_copy_takes_the_nearest_plane() -> None:
    planes = torch.arange(12.0).view(3, 2, 2)
    large = PlaneMap(image(2, 2), planes, torch.zeros(2, 2)).enlarged(image(4, 4))
    assert torch.equal(large, planes.repeat_interleave(2, 1).repeat_interleave(2, 2))


def flat(one: StereoImage, inverse: float, cost: float = 0.0) -> PlaneMap:
    """A wall across the viewing axis."""
    planes = torch.zeros(3, one.camera.height, one.camera.width)
    planes[2] = inverse
    return PlaneMap(one, planes, torch.full(planes.shape[1:], cost))


@pytest.mark.parametrize(
    ("apart", "depth", "costs", "focal", "agree"),
    [
        (0.1, 4.0, (0.0, 0.0), 50.0, True),
        (0.06, 4.0, (0.0, 0.0), 50.0, False),  # 0.86 degrees
        (0.08, 4.0, (0.0, 0.0), 50.0, True),  # 1.15 degrees
        (0.1, 4.07, (0.0, 0.0), 50.0, True),
        (0.1, 4.09, (0.0, 0.0), 50.0, False),  # more than 2 % deeper
        (0.1, 3.93, (0.0, 0.0), 50.0, True),
        (0.1, 3.91, (0.0, 0.0), 50.0, False),
        (0.1, 4.0, (0.39, 0.39), 50.0, True),
        (0.1, 4.0, (0.41, 0.0), 50.0, False),
        (0.1, 4.0, (0.0, 0.41), 50.0, False),
        (0.2, 4.05, (0.0, 0.0), 2000.0, True),  # 2000 · 0.2 · (1 / 4 - 1 / 4.05) = 1.2 px
        (0.2, 4.07, (0.0, 0.0), 3000.0, False),  # 2.6 px
    ],
)
def test_two_photos_agree_by_depth_place_cost_and_angle(
    apart: float, depth: float, costs: tuple[float, float], focal: float, agree: bool
) -> None:
    """The middle pixel of a wall four units away, which both see."""
    width = 40 if focal < 100 else 400
    here = flat(image(width, 30, focal), 1 / 4, costs[0])
    there = flat(image(width, 30, focal, x=apart), 1 / depth, costs[1])
    assert int(_confirmations(here, [there])[15, width // 2]) == agree
    assert int(_confirmations(here, [there, there])[15, width // 2]) == 2 * agree
    assert not bool(_confirmations(here, []).any())


def test_angles_are_those_between_the_directions_to_two_cameras() -> None:
    points = torch.tensor([[0.5, 0, 0.5], [0.5, 0, 3.0], [0.0, 0, 2.0]])
    found = _angles(points, image(), image(x=1.0))
    expected = torch.rad2deg(torch.tensor([torch.pi / 2, 2 * torch.atan(torch.tensor(1 / 6)), torch.pi / 2]))
    expected[2] = torch.rad2deg(torch.atan(torch.tensor(0.5)))
    torch.testing.assert_close(found, expected)


def test_the_nearest_photos_are_near_in_place_and_direction() -> None:
    """Turning by a right angle counts as much as a way of twice the distance to the focus."""
    focus = Focus(torch.tensor([0.0, 0, 3.0]), 3.0, 1.0, converging=True)
    first = image()
    beside = [image(x=away) for away in (6.1, 1.0, 5.9, 7.0, 2.0)]
    turned = StereoImage(image().camera, first.rgb)
    viewmat = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    turned.camera.viewmats[0] = viewmat
    everyone = [*beside, first, turned]  # the first itself is no neighbor
    places = {id(one): place for place, one in enumerate(everyone)}
    assert [places[id(one)] for one in nearest(first, everyone, focus)] == [1, 4, 2, 6, 0]
