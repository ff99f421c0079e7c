"""Fuses median depths into a truncated signed distance field (Curless & Levoy 1996), closed where nobody looks.

A voxel before the surfaces of a view is free there, one further behind them than the truncation is not seen. The field
is the mean over the views that see a voxel; a voxel that none sees is inside an object, and outside of a scene without
masks, where the surface becomes a shell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.results.mesh.median_depth import DepthView

TRUNCATION = 0.1
"""Share of the box's longest side over which a view's distance is followed; more of it averages over more views."""
_CHUNK = 1 << 19


@dataclass(frozen=True)
class Box:
    """Cubic voxels."""

    low: Float[Tensor, "3"]
    """Center of voxel (0, 0, 0)."""
    shape: tuple[int, int, int]
    voxel: float
    """Edge, scene units."""

    def corners(self) -> Float[Tensor, "8 3"]:
        high = self.low + self.voxel * torch.tensor([n - 1.0 for n in self.shape])
        return torch.cartesian_prod(*torch.stack([self.low, high], dim=1))

    def points(self, rows: Tensor) -> Float[Tensor, "M 3"]:
        """Centers of voxels by their flat index."""
        x = rows // (self.shape[1] * self.shape[2])
        y = rows // self.shape[2] % self.shape[1]
        return self.low + self.voxel * torch.stack([x, y, rows % self.shape[2]], dim=1)

    def chunks(self) -> Iterator[Float[Tensor, "M 3"]]:
        """The centers of all voxels in order, some at a time."""
        for rows in torch.arange(math.prod(self.shape)).split(_CHUNK):
            yield self.points(rows)


def truncation(box: Box) -> float:
    """Scene units."""
    return TRUNCATION * box.voxel * max(box.shape)


def box_around(low: Float[Tensor, "3"], high: Float[Tensor, "3"], voxels: int) -> Box:
    """`voxels` along the longest side, and four to spare all around."""
    voxel = float((high - low).max()) / voxels
    shape = [math.ceil(float(extent) / voxel) + 9 for extent in high - low]
    return Box(low - 4 * voxel, (shape[0], shape[1], shape[2]), voxel)


def fused(views: Sequence[DepthView], box: Box, *, solid: bool) -> Float[Tensor, "X Y Z"]:
    """The field over the box: -1 inside to 1 outside; `solid`: voxels that no view sees are inside."""
    parts, unseen = [], -1.0 if solid else 1.0
    for points in box.chunks():
        total, weight = torch.zeros(len(points)), torch.zeros(len(points))
        for view in views:
            distance, seen = signed_distance(view, points, truncation(box))
            total += torch.where(seen, distance, 0)
            weight += seen
        parts.append(torch.where(weight > 0, total / weight.clamp_min(1), unseen))
    return torch.cat(parts).view(box.shape)


def signed_distance(
    view: DepthView, points: Float[Tensor, "M 3"], truncation: float
) -> tuple[Float[Tensor, "M"], Bool[Tensor, "M"]]:
    """Distance before the surface in shares of the truncation, at most 1, and True where the view sees the point."""
    x, y, depth, shown = view.pixels(points)
    # A pixel without a surface says how far beside the surface the point lies, which falls to 0 at the outline.
    beside = view.gaps[y, x] * depth / float(view.camera.Ks[0, 0, 0])
    behind = view.depths[y, x] - depth
    distance = (torch.where(behind.isinf(), beside, behind) / truncation).clamp(max=1)
    return distance, shown & (distance >= -1)
