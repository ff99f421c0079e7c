"""The depths to believe: those that other photos confirm, and do not see through."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from gsopt.geometry.projection import inside, project
from gsopt.init.stereo.image import StereoImage, window_mean
from gsopt.init.stereo.search import PlaneMap

MAX_DEPTH_DIFFERENCE, MAX_PIXEL_SHIFT, MAX_COST, MIN_ANGLE = 0.02, 2.0, 0.4, 1.0
"""Two photos agree on a point if their depths differ by less than this share, it projects back to less than so many
pixels away, both match at less than this cost, and they see it from directions so many degrees apart: a camera that
only turns measures no depth."""
SEEN_THROUGH = 0.95
"""A photo sees through a point that is nearer than this share of the depth it has there."""
NEIGHBORHOOD, LEAST_BESIDE = 11, 0.4
"""Side of the window around a pixel, px, and the share of it that must be believed too, or the pixel is a speck."""
LEAST_STRUCTURE = 0.003
"""Change of gray per pixel, in the direction of the least, from which on a window matches one place alone."""


def agreed(maps: Sequence[PlaneMap]) -> list[Bool[Tensor, "H W"]]:
    """Pixels of each photo whose point more photos confirm than see through; without specks where nothing has
    structure, which agree by chance (docs/decisions/0042-what-stereo-believes.md)."""
    votes = [_confirmations(here, [other for other in maps if other is not here]) for here in maps]
    kept = []
    for here, count in zip(maps, votes, strict=True):
        others = [(other, found > 0) for other, found in zip(maps, votes, strict=True) if other is not here]
        believed = count > _views_through(here, others)
        kept.append(believed & (_in_company(believed) | (here.image.structure > LEAST_STRUCTURE)))
    return kept


def _confirmations(here: PlaneMap, others: Sequence[PlaneMap]) -> Int32[Tensor, "H W"]:
    """Number of photos that place a pixel's point there as well."""
    column, row = (values.flatten() for values in here.image.pixels)
    points = here.image.points(here.inverse_depths()).view(-1, 3)
    votes = torch.zeros(len(points), dtype=torch.int32)
    for other in others:
        rows, (y, x), depth = _shown(other, points)
        w = other.inverse_depths()
        same_depth = (1 / w[y, x] / depth - 1).abs() < MAX_DEPTH_DIFFERENCE
        back = project(here.image.camera, other.image.points(w)[y, x])
        moved = torch.hypot(back[0] - column[rows], back[1] - row[rows])
        matched = (moved < MAX_PIXEL_SHIFT) & (other.costs[y, x] < MAX_COST)
        votes[rows] += same_depth & matched & (_angles(points[rows], here.image, other.image) > MIN_ANGLE)
    return votes.view(here.costs.shape) * (here.costs < MAX_COST)


def _views_through(here: PlaneMap, others: Sequence[tuple[PlaneMap, Bool[Tensor, "H W"]]]) -> Int32[Tensor, "H W"]:
    """Number of photos with a confirmed point behind a pixel's point."""
    points = here.image.points(here.inverse_depths()).view(-1, 3)
    count = torch.zeros(len(points), dtype=torch.int32)
    for other, known in others:
        rows, (y, x), depth = _shown(other, points)
        count[rows] += known[y, x] & (depth * other.inverse_depths()[y, x] < SEEN_THROUGH)
    return count.view(here.costs.shape)


def _shown(
    other: PlaneMap, points: Float[Tensor, "N 3"]
) -> tuple[Int64[Tensor, "M"], tuple[Int64[Tensor, "M"], Int64[Tensor, "M"]], Float[Tensor, "M"]]:
    """The points that a photo has in its frame, the row and column of their pixels there, and their depths."""
    camera = other.image.camera
    column, row, depth = project(camera, points)
    rows = torch.nonzero(inside(camera, column, row, depth))[:, 0]
    x, y = column[rows].long().clamp(0, camera.width - 1), row[rows].long().clamp(0, camera.height - 1)
    return rows, (y, x), depth[rows]


def _in_company(believed: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    return window_mean(believed[None].float(), NEIGHBORHOOD)[0] > LEAST_BESIDE


def _angles(points: Float[Tensor, "N 3"], one: StereoImage, other: StereoImage) -> Float[Tensor, "N"]:
    """Angles between the directions in which two cameras see points, degrees."""
    a, b = points - one.camera.centers[0], points - other.camera.centers[0]
    across = torch.linalg.cross(a, b).norm(dim=-1)
    return torch.rad2deg(torch.atan2(across, (a * b).sum(-1)))
