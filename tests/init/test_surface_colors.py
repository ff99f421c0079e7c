"""Colors on a block of voxels between two cameras that look at each other."""

from __future__ import annotations

import math

import pytest
import torch

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.voxels import Grid
from gsopt.init.surface_colors import front_of, seen_colors, unoccluded_colors
from gsopt.init.thumbnails import Thumbnail

SIDE, FOCAL = 50, 100.0
K = torch.tensor([[[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]]])


def photo(channel: int, *, turned: bool = False) -> Thumbnail:
    """One color, seen from z = -10 along z, or from z = 10 against it."""
    viewmat = torch.diag(torch.tensor([-1.0, 1, -1, 1])) if turned else torch.eye(4)
    viewmat[2, 3] = 10
    planes = torch.zeros(4, SIDE, SIDE, dtype=torch.uint8)
    planes[channel], planes[3] = 255, 255
    return Thumbnail(Cameras(viewmat[None], K, SIDE, SIDE), planes)


def block() -> Grid:
    """A cube of 2 units around the origin, of 20 x 20 x 20 voxels."""
    return Grid(torch.ones(20, 20, 20, dtype=torch.bool), torch.full((3,), -1.0), 0.1)


RED, BLUE = [1.0, 0, 0], [0, 0, 1.0]
GRAY = [0.5, 0.5, 0.5]


def test_the_front_is_the_nearest_layer_of_voxels_in_blocks_of_about_a_voxel() -> None:
    """A voxel is 0.1 · 100 / 10 = 1 px wide at the middle: one and a half of it are 2 px."""
    grid = block()
    front = front_of(grid, photo(0), grid.surface())
    assert front.step == 2
    assert front.depths.shape == (25, 25)
    middle = front.depths[10:15, 10:15]
    torch.testing.assert_close(middle, torch.full((5, 5), 9.05), atol=1e-4, rtol=0)
    assert bool(front.depths[0].isinf().all())
    assert bool(front.depths[:, -1].isinf().all())


def test_a_point_is_buried_by_its_depth_behind_the_front() -> None:
    grid = block()
    front = front_of(grid, photo(0), grid.surface())
    points = torch.tensor([[0.0, 0, -0.95], [0.0, 0, -2.0], [0.3, 0.2, 0.5], [0, 0, -20], [9, 0, 0]])
    torch.testing.assert_close(
        front.buried(points), torch.tensor([0.0, 0.0, 1.45, math.inf, math.inf]), atol=1e-4, rtol=0
    )


def test_without_a_voxel_in_the_photo_the_blocks_are_those_of_a_voxel_of_a_pixel() -> None:
    grid = block()
    front = front_of(grid, photo(0), grid.surface() + 1000)
    assert front.step == 2
    assert bool(front.depths.isinf().all())


@pytest.mark.parametrize(
    ("z", "seen", "nearest"),
    [(-0.95, RED, RED), (-0.85, RED, RED), (-0.75, None, RED), (0.75, None, BLUE), (0.95, BLUE, BLUE)],
)
def test_each_side_takes_the_colors_of_the_photo_before_it(z: float, seen: list | None, nearest: list) -> None:
    """A voxel and a half behind the front counts as seen; inside, the nearest front decides."""
    points = torch.tensor([[0.0, 0, z]])
    photos = [photo(0), photo(2, turned=True)]
    colors, shown = seen_colors(block(), photos, points)
    assert shown.tolist() == [seen is not None]
    assert colors[0].tolist() == pytest.approx(GRAY if seen is None else seen, abs=1e-4)
    assert unoccluded_colors(block(), photos, points)[0].tolist() == pytest.approx(nearest, abs=1e-4)


def test_in_the_middle_both_sides_count_alike() -> None:
    found = unoccluded_colors(block(), [photo(0), photo(2, turned=True)], torch.tensor([[0.0, 0, 0.05]]))
    assert found[0].tolist() == pytest.approx([0.5, 0, 0.5], abs=1e-4)


def test_what_no_photo_shows_is_gray() -> None:
    points = torch.tensor([[50.0, 0, 0]])
    colors, shown = seen_colors(block(), [photo(0)], points)
    assert colors[0].tolist() == unoccluded_colors(block(), [photo(0)], points)[0].tolist() == GRAY
    assert not bool(shown.any())
