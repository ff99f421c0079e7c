"""The steps of the hull and of the inflated body, each by hand: widening, boxes, planes."""

from __future__ import annotations

import math

import pytest
import torch

from gsopt.geometry.cameras import Cameras, look_at
from gsopt.init.guessed_views import voxel_gaussians
from gsopt.init.hull import _spread, _widened, admits, in_hull
from gsopt.init.inflation import object_box, plane_normal
from gsopt.init.thumbnails import Thumbnail

SIDE = 40
K = torch.tensor([[[100.0, 0, SIDE / 2], [0, 100, SIDE / 2], [0, 0, 1]]])
CAMERA = Cameras(torch.eye(4)[None], K, SIDE, SIDE)


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 5, 8])
def test_a_running_maximum_reaches_as_far_to_both_sides(reach: int) -> None:
    planes = torch.rand(1, 4, 15, generator=torch.Generator().manual_seed(reach))
    expected = torch.stack([planes[..., max(0, x - reach) : x + reach + 1].amax(-1) for x in range(15)], dim=-1)
    assert torch.equal(_spread(planes, reach), expected)


@pytest.mark.parametrize(("radius", "pixels"), [(0.05, 1), (0.1, 1), (0.11, 2), (0.3, 3)])
def test_a_silhouette_widens_by_what_a_radius_covers_at_the_median_depth(radius: float, pixels: int) -> None:
    """At a depth of ten a tenth of a unit is a pixel."""
    planes = torch.zeros(4, SIDE, SIDE, dtype=torch.uint8)
    planes[3, 20, 10] = 255
    found = _widened(Thumbnail(CAMERA, planes), radius, torch.tensor([[0.0, 0, 10], [1, 0, 10], [0, 1, 99]]))[0]
    rows, columns = (found > 0.5).nonzero().unbind(1)
    assert (int(rows.min()), int(rows.max())) == (20 - pixels, 20 + pixels)
    assert (int(columns.min()), int(columns.max())) == (10 - pixels, 10 + pixels)
    assert len(rows) == (2 * pixels + 1) ** 2


def test_a_photo_of_the_whole_object_keeps_balls_that_may_reach_into_it() -> None:
    """A radius of one at a depth of eleven, whose near side is ten away, reaches ten pixels beyond the border."""
    planes = torch.zeros(4, SIDE, SIDE, dtype=torch.uint8)
    planes[3, 10:30, 10:30] = 255
    across = torch.tensor([-2.9, -3.1, 2.9, 3.1])
    points = torch.stack([1.1 * across, torch.zeros(4), torch.full((4,), 11.0)], dim=1)
    around = torch.tensor([[900.0, 0, 1], [0, 0, -3]])
    for places in (points, points[:, [1, 0, 2]]):
        admitted = admits(Thumbnail(CAMERA, planes), torch.cat([places, around]), 1.0)
        assert admitted.tolist() == [True, False] * 2 + [True, True]
        assert not bool(admits(Thumbnail(CAMERA, planes), places).any())


@pytest.mark.parametrize("radius", [0.0, 1.0])
def test_a_photo_of_a_part_of_the_object_carves_nothing_beside_the_image(radius: float) -> None:
    planes = torch.zeros(4, SIDE, SIDE, dtype=torch.uint8)
    planes[3, 10:30, 30:] = 255
    beside = torch.tensor([[-3.1, 0.0, 11.0], [-2.0, 0.0, 11.0]])
    photo = Thumbnail(CAMERA, planes)
    assert admits(photo, beside, radius).tolist() == [True, False]
    assert not bool(in_hull([photo], beside, radius).any()), "half of the photos must show a point"


def test_the_box_of_an_object_lies_at_the_focus_around_its_pixels() -> None:
    """A camera at z = -4 looks at the origin; 10 x 6 px whose middle is 5 px to the right and 3 px above."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4
    camera = Cameras(viewmat[None], K, SIDE, SIDE)
    solid = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    solid[14:20, 20:30] = True
    middle, half, frame = object_box(camera, solid, 1.0)
    assert middle.tolist() == pytest.approx([5 * 4 / 100, -3 * 4 / 100, 0], abs=1e-6)
    assert half == pytest.approx(1.25 * 4 * math.hypot(5, 3) / 100)
    assert frame == pytest.approx(4 * 20 / 100)


@pytest.mark.parametrize(("elevation", "level"), [(0, True), (49, True), (51, False), (-49, True), (-51, False)])
def test_the_plane_of_the_body_is_upright_unless_the_camera_looks_steeply(elevation: float, level: bool) -> None:
    angle = math.radians(elevation)
    eye = torch.tensor([[4 * math.cos(angle), 0.0, 4 * math.sin(angle)]])
    viewmats = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1]))
    normal = plane_normal(Cameras(viewmats, K, SIDE, SIDE))
    expected = torch.tensor([-1.0, 0, 0]) if level else torch.tensor([0.0, 0, 1])
    torch.testing.assert_close(normal, expected, atol=1e-5, rtol=0)


def test_drawn_voxels_are_opaque_balls_of_their_color() -> None:
    points, rgb = torch.eye(3), torch.tensor([[0.5, 0.5, 0.5], [1, 0, 0], [0, 1, 0.25]])
    found = voxel_gaussians(points, rgb, 0.2).validate()
    torch.testing.assert_close(found.scales, torch.full((3, 3), 0.2))
    assert float(found.opacities.min()) == pytest.approx(1 / (1 + math.exp(-6)))
    assert float(found.opacities.max()) < 0.999
    assert found.quats.tolist() == [[1, 0, 0, 0]] * 3
    assert torch.equal(found.sh0[0], torch.zeros(1, 3)), "gray is the harmonics' zero"
    assert found.sh_degree == 0
