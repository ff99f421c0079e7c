"""The visual hull: the largest shape whose silhouettes agree with every input view (Laurentini 1994).

Carved on voxels, coarse to fine, then sampled: points are placed at random in the voxels and kept where every
silhouette holds them, so a point's accuracy is that of the masks and not of the voxels (GaussianObject, Yang et al.
2024, starts from such points). With few silhouettes only the round part of the hull is filled (`rounded`),
and a single one is inflated (gsopt/init/inflation.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.lookup import Picture, lowest
from gsopt.data.scene import Scene
from gsopt.geometry.focus import Focus, find_focus
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid, dilated, eroded
from gsopt.init.inflation import inflated
from gsopt.init.rim_colors import without_rim
from gsopt.init.rounded_hull import rounded
from gsopt.init.surface_colors import unoccluded_colors
from gsopt.init.thumbnails import Thumbnail, small_photos

SURFACE_SHARE = 0.7
"""Share of the points within a voxel of the hull's surface. The rest fill it: the hull is larger than the object, and
what is carved away during training must find Gaussians behind it to take over. On few views 0.4 to 0.7 do equally well
and 1 (none inside) clearly worse."""
MAX_PHOTOS = 100
"""Most silhouettes used; more hardly carve."""
UNROUNDED_FROM = 16
"""Silhouettes from which on the hull itself is taken: it has hardly a corner left."""
COARSE_SIDE = 48
"""Voxels along each side of the first grid."""
_MAX_LOOKUPS = 6e7
"""Voxels times views of the second grid: bounds its time."""
_MIN_SIDE, _MAX_SIDE = 48, 112
"""Voxels along each side of the second grid."""
_SOLID_ALPHA = 0.5
"""Alpha above which a pixel belongs to the object."""
_CARVED, _PASSED = 0.0, 1.0
"""Alphas of what a photo does not show, when that cannot belong to the object and when it can."""
_DEPTH_SAMPLES = 4096
"""Points that stand for all where a median depth is asked for."""
_FULL_COVERAGE = 0.98
"""Silhouettes that cover more than this of all pixels outline nothing."""
_MAX_ROUNDS = 24


@dataclass(frozen=True)
class HullPoints:
    """Colored points in the hull."""

    xyz: Float[Tensor, "N 3"]
    rgb: Float[Tensor, "N 3"]
    silhouettes: int
    voxel: float
    """Edge of the finest voxels, scene units."""


def hull_points(scene: Scene, count: int, generator: torch.Generator) -> HullPoints | None:
    """`count` colored points on and in the hull of the input views, or None for silhouettes that enclose nothing."""
    photos = small_photos(scene.observed, MAX_PHOTOS)
    covered = sum(float((photo.planes[3] > 127).double().mean()) for photo in photos) / len(photos)
    if covered > _FULL_COVERAGE:
        return None
    if scene.guessed:
        grid = scene.body or inflated(photos[0], scene.extent)
    else:
        grid = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    if grid is None:
        return None
    if len(photos) < UNROUNDED_FROM and not scene.guessed:
        cells = rounded(grid.occupied, grid.centers(grid.occupied), grid.voxel, photos)
        grid = replace(grid, occupied=cells)
    xyz = _sample_points(grid, photos, count, generator)
    if len(xyz) == 0:
        return None
    colored = [without_rim(photo) if scene.guessed else photo for photo in photos if photo.colored]
    return HullPoints(xyz, unoccluded_colors(grid, colored, xyz), len(photos), grid.voxel)


def carve(photos: list[Thumbnail], focus: Focus) -> Grid | None:
    """Finds the object's box on a coarse grid, then carves a fine one inside it; returns None for an empty hull."""
    half = 2 * focus.radius
    coarse = _carved(photos, focus.point - half, torch.full((3,), 2 * half), COARSE_SIDE, cautious=True)
    if not bool(coarse.occupied.any()):
        return None
    cells = torch.nonzero(coarse.occupied)
    low = coarse.low + (cells.amin(0) - 1) * coarse.voxel
    size = (cells.amax(0) - cells.amin(0) + 3) * coarse.voxel
    side = int(min(max((_MAX_LOOKUPS / len(photos)) ** (1 / 3), _MIN_SIDE), _MAX_SIDE))
    fine = _carved(photos, low, size, side, cautious=False)
    if not bool(fine.occupied.any()):  # thinner than a voxel everywhere
        fine = _carved(photos, low, size, side, cautious=True)
    return fine if bool(fine.occupied.any()) else None


def _carved(
    photos: list[Thumbnail], low: Float[Tensor, "3"], size: Float[Tensor, "3"], side: int, *, cautious: bool
) -> Grid:
    """About side³ cubic voxels that fill a box, kept where their centers (or, cautiously, any part) are in the hull."""
    voxel = float(size.prod()) ** (1 / 3) / side
    shape = [max(1, math.ceil(float(extent) / voxel)) for extent in size]
    grid = Grid(torch.ones(shape, dtype=torch.bool), low, voxel)
    kept = in_hull(photos, grid.all_centers(), voxel * math.sqrt(3) / 2 if cautious else 0.0)
    return Grid(kept.view(shape), low, voxel)


def in_hull(photos: list[Thumbnail], points: Float[Tensor, "N 3"], radius: float = 0.0) -> Bool[Tensor, "N"]:
    """True where every photo that shows a point shows it solid, and at least half of the photos show it. A photo with
    all of the object in it must show the point: without that, few views leave a second hull beside the first, in what
    only two of them see (4 views of a stone lantern: 21.6 dB instead of 23.7).

    With a `radius` (scene units) a point counts as solid, and as shown, when anything within it may be.
    """
    pictures = [_picture(photo, radius, points) for photo in photos]
    alpha, shown = lowest(pictures, points, beside=_PASSED, radius=radius, enough=_SOLID_ALPHA)
    return (alpha > _SOLID_ALPHA) & (2 * shown >= len(photos))


def admits(photo: Thumbnail, points: Float[Tensor, "N 3"], radius: float = 0.0) -> Bool[Tensor, "N"]:
    """True for points that one photo does not carve away."""
    return lowest([_picture(photo, radius, points)], points, beside=_PASSED, radius=radius)[0] > _SOLID_ALPHA


def _picture(photo: Thumbnail, radius: float, points: Float[Tensor, "N 3"]) -> Picture:
    """The alpha of a photo, and of all that it does not show."""
    return Picture(photo.camera, _widened(photo, radius, points)[0], _CARVED if photo.shows_all() else _PASSED)


def _widened(photo: Thumbnail, radius: float, points: Float[Tensor, "N 3"]) -> Float[Tensor, "1 H W"]:
    """Alpha spread by what `radius` covers at the median depth of the points that the photo shows, px."""
    alpha = photo.alpha()
    if radius == 0:
        return alpha
    column, row, depth = project(photo.camera, points[:: math.ceil(len(points) / _DEPTH_SAMPLES) or 1])
    depth = depth[inside(photo.camera, column, row, depth)]
    if len(depth) == 0:
        return alpha
    reach = radius * float(photo.camera.Ks[0].diagonal()[:2].max()) / float(depth.median())
    pixels = min(math.ceil(reach), max(alpha.shape[1:]))
    return spread(alpha, pixels)


def spread(planes: Float[Tensor, "1 H W"], reach: int) -> Float[Tensor, "1 H W"]:
    """The largest value up to `reach` pixels away along both axes."""
    return _spread(_spread(planes, reach).mT, reach).mT.contiguous()


def _spread(planes: Float[Tensor, "1 H W"], reach: int) -> Float[Tensor, "1 H W"]:
    """Running maximum along the rows over `reach` pixels to either side, the window doubled at each step."""
    planes = torch.nn.functional.pad(planes, (reach, reach))
    window = 1
    while window < 2 * reach + 1:
        step = min(window, 2 * reach + 1 - window)
        planes = torch.maximum(planes[..., :-step], planes[..., step:])
        window += step
    return planes


def _sample_points(grid: Grid, photos: list[Thumbnail], count: int, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """Points near the surface and points inside, each accepted by `in_hull`."""
    core = eroded(grid.occupied)
    rim = dilated(grid.occupied) & ~core
    on_surface = count if not bool(core.any()) else round(SURFACE_SHARE * count)
    surface = _accepted(grid, rim, photos, on_surface, generator)
    inner = _accepted(grid, core, photos, count - len(surface), generator)
    return torch.cat([surface, inner])


def _accepted(
    grid: Grid, cells: Bool[Tensor, "X Y Z"], photos: list[Thumbnail], count: int, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """`count` uniform random points in `cells` and in the hull; fewer when few places are."""
    corners = grid.centers(cells) - 0.5 * grid.voxel
    accepted = [torch.empty(0, 3)]
    for _ in range(_MAX_ROUNDS if len(corners) else 0):
        missing = count - sum(map(len, accepted))
        if missing <= 0:
            break
        drawn = torch.randint(len(corners), (2 * missing,), generator=generator)
        points = corners[drawn] + grid.voxel * torch.rand(2 * missing, 3, generator=generator)
        accepted.append(points[in_hull(photos, points)])
    return torch.cat(accepted)[:count]
