"""Colors that photos show on the surface of a shape made of voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.resample import sample
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.thumbnails import Thumbnail, colors_from_sums

_CHUNK = 1 << 16


@dataclass(frozen=True)
class Front:
    """The front surface of a shape in one photo."""

    photo: Thumbnail
    depths: Float[Tensor, "h w"]
    """Smallest depth of the shape per block of pixels, infinite where there is none."""
    step: int
    """Edge of a block, px: about a voxel."""

    def buried(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Distance of each point behind the front, scene units; infinite outside the photo."""
        column, row, depth = project(self.photo.camera, points)
        shown = torch.nonzero(inside(self.photo.camera, column, row, depth))[:, 0]
        height, width = self.depths.shape
        found = torch.full((len(points),), math.inf)
        found[shown] = (
            depth[shown] - self.depths[_cells(row[shown], self.step, height), _cells(column[shown], self.step, width)]
        ).clamp(min=0)
        return found


def front_of(grid: Grid, photo: Thumbnail, surface: Float[Tensor, "M 3"]) -> Front:
    """The front of a shape, from the centers of its surface voxels."""
    column, row, depth = project(photo.camera, surface)
    shown = inside(photo.camera, column, row, depth)
    column, row, depth = column[shown], row[shown], depth[shown]
    footprint = grid.voxel * float(photo.camera.Ks[0, 0, 0]) / float(depth.median()) if len(depth) else 1.0
    step = max(1, math.ceil(1.5 * footprint))
    height, width = math.ceil(photo.camera.height / step), math.ceil(photo.camera.width / step)
    block = _cells(row, step, height) * width + _cells(column, step, width)
    depths = torch.full((height * width,), math.inf).scatter_reduce(0, block, depth, "amin")
    return Front(photo, depths.view(height, width), step)


def unoccluded_colors(grid: Grid, photos: Sequence[Thumbnail], points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Mean color over the photos in which a point lies nearest behind the shape's front surface.

    For a point on the surface these are the photos that see it; for one inside, those that see the surface before it.
    """
    surface = grid.surface()
    fronts = [front_of(grid, photo, surface) for photo in photos]
    # A voxel and a half: the front depths are those of voxel centers.
    chunks = [_sums(fronts, chunk, 1.5 * grid.voxel, nearest=True) for chunk in points.split(_CHUNK)]
    return torch.cat([colors_from_sums(total) for total in chunks])


def seen_colors(
    grid: Grid, photos: Sequence[Thumbnail], points: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 3"], Bool[Tensor, "N"]]:
    """Mean color over the photos that see a point of the surface, and True when any does."""
    surface = grid.surface()
    fronts = [front_of(grid, photo, surface) for photo in photos]
    total = _sums(fronts, points, 1.5 * grid.voxel, nearest=False)
    return colors_from_sums(total), total[3] > 0.5


def _sums(
    fronts: Sequence[Front], points: Float[Tensor, "N 3"], tolerance: float, *, nearest: bool
) -> Float[Tensor, "4 N"]:
    """Premultiplied color and alpha, added up over the photos in which a point lies no more than `tolerance` behind
    the front, or behind the one it is `nearest` to."""
    buried = torch.stack([front.buried(points) for front in fronts])
    chosen = buried <= (buried.amin(dim=0) if nearest else 0.0) + tolerance
    total = torch.zeros(4, len(points))
    for front, here, depth in zip(fronts, chosen, buried, strict=True):
        rows = torch.nonzero(here & depth.isfinite())[:, 0]
        column, row, _ = project(front.photo.camera, points[rows])
        total[:, rows] += sample(front.photo.planes.float(), column, row) / 255
    return total


def _cells(coordinate: Tensor, step: int, count: int) -> Tensor:
    return (coordinate / step).long().clamp(0, count - 1)
