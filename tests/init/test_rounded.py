"""The roundest shape in a hull: what thickness is, and what (1) keeps and takes away."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from shapes import ellipsoid_scene, spread_cameras

from gsopt.data.scene import load_scene
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus
from gsopt.geometry.voxels import Grid
from gsopt.init.hull import carve
from gsopt.init.rounded_hull import RADIUS_RATIO, rounded, thickest, thickness
from gsopt.init.thumbnails import Thumbnail, small_photos

pytestmark = pytest.mark.usefixtures("coarse_hull")

CENTER = (0.3, -0.2, 0.1)


def hull_of(
    folder: Path, views: int, radii: tuple[float, float, float] = (0.7, 0.6, 0.65)
) -> tuple[Grid, list[Thumbnail]]:
    scene = load_scene(ellipsoid_scene(folder, spread_cameras(views), CENTER, radii))
    photos = small_photos(scene.train, views)
    grid = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    assert grid is not None
    return grid, photos


def in_ellipsoid(grid: Grid, radii: tuple[float, float, float]) -> torch.Tensor:
    centers = grid.centers(torch.ones_like(grid.occupied))
    inside = ((centers - torch.tensor(CENTER)) / torch.tensor(radii)).norm(dim=1) <= 1
    return inside.view(grid.occupied.shape)


def test_the_thickness_of_a_ball_a_slab_and_a_rod() -> None:
    """Each holds balls as large as itself, side by side in one grid."""
    x, y, z = torch.meshgrid(*(torch.arange(60) for _ in range(3)), indexing="ij")
    ball = (x - 15) ** 2 + (y - 15) ** 2 + (z - 15) ** 2 <= 12**2
    slab = (x >= 35) & (x < 43) & (y > 0) & (y < 58) & (z > 0) & (z < 58)
    rod = (y - 45) ** 2 + (z - 45) ** 2 <= 3**2
    rod = rod & (x < 30)
    thick = thickness(ball | slab | rod)
    for part, radius in ((ball, 12), (slab, 4), (rod, 3)):
        middle = thick[part].median()
        assert radius / RADIUS_RATIO - 1 <= float(middle) <= radius + 1
    assert bool((thick[~(ball | slab | rod)] == 0).all())
    assert not bool(thickness(torch.zeros(4, 4, 4, dtype=torch.bool)).any())


@pytest.mark.parametrize("squared", [1, 2, 3, 4, 5])
def test_the_thickness_is_the_largest_ball_of_its_definition(squared: int) -> None:
    """A ball with holes, whose squared radius is no square; each level written out over all pairs of cells."""
    cells = torch.rand(11, 9, 10, generator=torch.Generator().manual_seed(squared)) < 0.93
    offset = torch.cartesian_prod(*(torch.arange(size) for size in cells.shape)) - torch.tensor([5, 4, 5])
    cells &= offset.square().sum(1).view(cells.shape) < squared
    places = torch.nonzero(torch.nn.functional.pad(~cells, (1,) * 6, value=True)) - 1
    inside = torch.nonzero(cells)
    depth = torch.cdist(inside.double(), places.double()).square().round().amin(1)
    between = torch.cdist(inside.double(), inside.double()).square().round()
    largest, expected = math.sqrt(float(depth.max())), torch.zeros(len(inside))
    for level in range(99, -1, -1):
        radius = largest / RADIUS_RATIO**level
        if radius >= 1:
            expected[(between[:, depth > radius**2 - 1e-6] < radius**2 + 1e-6).any(1)] = radius
    assert torch.equal(thickness(cells)[cells], expected)


@pytest.mark.parametrize("views", [3, 4, 6])
def test_what_lies_beside_a_ball_goes_and_the_ball_stays(views: int, tmp_path: Path) -> None:
    radii = (0.65, 0.65, 0.65)
    grid, photos = hull_of(tmp_path, views, radii)
    kept = rounded(grid.occupied, grid.centers(grid.occupied), grid.voxel, photos)
    ball = in_ellipsoid(grid, radii)
    assert not bool((kept & ~grid.occupied).any())
    assert int((kept & ~ball).sum()) < 0.5 * int((grid.occupied & ~ball).sum())
    assert int((kept & ball).sum()) > 0.85 * int(ball.sum())


def test_every_silhouette_remains_filled(tmp_path: Path) -> None:
    grid, photos = hull_of(tmp_path, 4)
    # With a thin antenna on top, which is a hull of its own where nothing thick stands before it.
    cells = grid.occupied.clone()
    x, y, top = (int(i) for i in torch.nonzero(cells)[torch.nonzero(cells)[:, 2].argmax()])
    cells = torch.nn.functional.pad(cells, (0, 12))
    cells[x : x + 2, y : y + 2, top : top + 12] = True
    grid = Grid(cells, grid.low, grid.voxel)
    kept = rounded(cells, grid.centers(cells), grid.voxel, photos)
    assert float(kept[x : x + 2, y : y + 2, top + 6 : top + 12].float().mean()) == 1
    for photo in photos:
        points = grid.centers(cells)
        full = thickest(photo, points, grid.voxel, torch.ones(len(points)))
        filled = thickest(photo, points, grid.voxel, kept[cells].float())
        seen = full.isfinite()
        assert bool(seen.any())
        assert bool((filled[seen] == 1).all())


def test_what_no_photo_shows_stays(tmp_path: Path) -> None:
    grid, photos = hull_of(tmp_path, 3)
    far = grid.centers(grid.occupied) + 1e4
    assert torch.equal(rounded(grid.occupied, far, grid.voxel, photos), grid.occupied)


def test_a_point_on_the_border_belongs_to_the_last_pixel() -> None:
    K = torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]])
    photo = Thumbnail(Cameras(torch.eye(4)[None], K, 100, 100), torch.full((4, 100, 100), 255, dtype=torch.uint8))
    points = torch.tensor([[0.0, 0.5, 1.0], [0.5, 0.1, 1.0], [0.5, 0.5, 1.0]])
    assert thickest(photo, points, 0.001, torch.tensor([1.0, 2, 3])).tolist() == [1, 2, 3]


def test_a_point_on_the_border_shares_the_last_of_wide_pixels() -> None:
    """A voxel is two pixels wide here."""
    K = torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]])
    photo = Thumbnail(Cameras(torch.eye(4)[None], K, 100, 100), torch.full((4, 100, 100), 255, dtype=torch.uint8))
    points = torch.tensor([[0.5, 0.1, 1.0], [0.49, 0.1, 1.0], [0.1, 0.5, 1.0], [0.1, 0.49, 1.0]])
    assert thickest(photo, points, 0.02, torch.tensor([1.0, 2, 3, 4])).tolist() == [2, 2, 4, 4]


def test_the_last_pixel_is_not_the_one_before() -> None:
    K = torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]])
    photo = Thumbnail(Cameras(torch.eye(4)[None], K, 100, 100), torch.full((4, 100, 100), 255, dtype=torch.uint8))
    points = torch.tensor([[0.495, 0.1, 1.0], [0.485, 0.1, 1.0], [0.1, 0.495, 1.0], [0.1, 0.485, 1.0]])
    assert thickest(photo, points, 0.001, torch.tensor([1.0, 2, 3, 4])).tolist() == [1, 2, 3, 4]
