"""A visual hull without the corners that no silhouette needs.

The hull is the largest of all shapes with the given silhouettes (Franco, Lapierre & Boyer 2006); beside the object,
where the cones of two views cross, it keeps wedges of matter that is not there. Few things have such edges. So every
pixel of a silhouette is explained by the thickest matter behind it: with T(x) the radius of the largest ball in the
hull that holds voxel x (local thickness, Hildebrand & Rüegsegger 1997),

    (1)  keep x where  T(x) >= min over views v of  max T(y) over the voxels y in the pixel of x in v.

An edge is thin and lies before or behind something thick in all views; a leg or a handle that stands out in one view is
the thickest in its pixels there and stays. Every silhouette remains filled. Matter that hides before thicker parts in
all views is lost, as is the middle of an egg's sides: training puts it back. It adds matter far more readily than it
takes matter away (docs/decisions/0001-schedule.md has the figures).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.distances import squared_distance
from gsopt.geometry.projection import inside, project
from gsopt.init.thumbnails import Thumbnail

ROUNDS = 2
"""The remains are measured again: without the tips their stumps are thin."""
RADIUS_RATIO = 1.1
"""Ratio of two successive radii."""


def rounded(
    cells: Bool[Tensor, "X Y Z"], centers: Float[Tensor, "M 3"], voxel: float, photos: list[Thumbnail]
) -> Bool[Tensor, "X Y Z"]:
    """The voxels that (1) keeps; `centers` are those of the true ones, in scene units as their edge `voxel`."""
    for _ in range(ROUNDS):
        thick = thickness(cells)[cells]
        wanted = torch.full_like(thick, math.inf)
        for photo in photos:
            wanted = torch.minimum(wanted, thickest(photo, centers, voxel, thick))
        stays = (thick >= wanted) | wanted.isinf()
        cells = cells.masked_scatter(cells, stays)
        centers = centers[stays]
    return cells


def thickest(
    photo: Thumbnail, points: Float[Tensor, "M 3"], voxel: float, thick: Float[Tensor, "M"]
) -> Float[Tensor, "M"]:
    """For every point the largest thickness in its pixel (as wide as a voxel at the middle depth); infinite where the
    photo does not show it."""
    column, row, depth = project(photo.camera, points)
    shown = inside(photo.camera, column, row, depth)
    found = torch.full_like(thick, math.inf)
    if not bool(shown.any()):
        return found
    step = max(1, math.ceil(voxel * float(photo.camera.Ks[0, 0, 0]) / float(depth[shown].median())))
    width, height = math.ceil(photo.camera.width / step), math.ceil(photo.camera.height / step)
    # A point on the far border counts as shown, by the last pixel.
    x, y = ((column[shown] / step).long().clamp(max=width - 1), (row[shown] / step).long().clamp(max=height - 1))
    pixel = y * width + x
    most = torch.zeros(width * height).scatter_reduce(0, pixel, thick[shown], "amax")
    found[shown] = most[pixel]
    return found


def thickness(cells: Bool[Tensor, "X Y Z"]) -> Float[Tensor, "X Y Z"]:
    """Per true cell the radius of the largest ball of true cells that holds it, in cells, in steps of RADIUS_RATIO down
    from the largest of all; 0 elsewhere."""
    solid = torch.nn.functional.pad(cells, (1,) * 6)
    depth = squared_distance(~solid, max(solid.shape))
    largest = math.sqrt(int(depth.max()))
    thick = torch.zeros(solid.shape)
    for level in reversed(range(1 + int(math.log(max(1.0, largest), RADIUS_RATIO)))):
        radius = largest / RADIUS_RATIO**level
        centers = depth >= radius**2
        within = _box(centers, math.ceil(radius))
        covered = squared_distance(centers[within], math.ceil(radius)) <= radius**2
        thick[within].masked_fill_(covered, radius)
    return (thick * solid)[1:-1, 1:-1, 1:-1]


def _box(cells: Bool[Tensor, "X Y Z"], margin: int) -> tuple[slice, ...]:
    """The box of the true cells and a margin around it, within the grid."""
    planes = cells.any(2)
    occupied = planes.any(1), planes.any(0), cells.any(0).any(0)
    spans = [torch.nonzero(along)[:, 0] for along in occupied]
    return tuple(slice(max(0, int(span[0]) - margin), int(span[-1]) + margin + 1) for span in spans)
