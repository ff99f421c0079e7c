"""The part of a photo that shows the object: by its mask, or by where the masks of other photos say that it is."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import inside, project
from gsopt.init.hull import carve
from gsopt.init.rounded_hull import rounded
from gsopt.init.thumbnails import Thumbnail

MARGIN = 0.12
"""Border around the object, shares of its longer side."""
Box = tuple[int, int, int, int]
"""Left, top, right, bottom, px."""


def box_around(solid: Bool[Tensor, "H W"], width: int, height: int) -> Box | None:
    """The box of the true pixels with a margin, in an image of this size; Returns None without any."""
    rows, columns = solid.any(1).nonzero()[:, 0], solid.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        return None
    across, down = width / solid.shape[1], height / solid.shape[0]
    left, right = int(columns[0]) * across, (int(columns[-1]) + 1) * across
    top, bottom = int(rows[0]) * down, (int(rows[-1]) + 1) * down
    return _widened(left, top, right, bottom, width, height)


def object_points(photos: list[Thumbnail], focus: Focus) -> Float[Tensor, "M 3"]:
    """Points of the round part of the hull, which is little larger than the object; none for an empty hull."""
    grid = carve(photos, focus)
    if grid is None:
        return torch.empty(0, 3)
    cells = rounded(grid.occupied, grid.centers(), grid.voxel, photos)
    return replace(grid, occupied=cells).centers()


def box_of_points(camera: Cameras, points: Float[Tensor, "M 3"]) -> Box | None:
    """The box of projected points with a margin, px; Returns None where the camera sees none."""
    column, row, depth = project(camera, points)
    seen = inside(camera, column, row, depth)
    if not bool(seen.any()):
        return None
    columns, rows = column[seen], row[seen]
    extent = float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max())
    return _widened(*extent, camera.width, camera.height)


def overlap(a: Box, b: Box) -> float:
    """Intersection over union."""
    common = (max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3]))
    shared = area(common) if common[0] < common[2] and common[1] < common[3] else 0
    return shared / (area(a) + area(b) - shared)


def area(box: Box) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _widened(left: float, top: float, right: float, bottom: float, width: int, height: int) -> Box:
    margin = MARGIN * max(right - left, bottom - top)
    low = max(0, int(left - margin)), max(0, int(top - margin))
    return *low, min(width, round(right + margin)), min(height, round(bottom + margin))
