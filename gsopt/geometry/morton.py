"""Z-order: points that are near in space become near in memory (Morton 1966)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.geometry.precision import in_float64

BITS = 21
"""Per axis: three axes fill 63 bits."""
# Each step moves the upper half of the bits up, until two zeros stand between any two.
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(points: Float[Tensor, "N 3"]) -> Int[Tensor, "N"]:
    """Indices that sort `points` along a Z curve through their bounding box; the last axis decides first, ties keep
    their order."""
    if len(points) == 0:
        return torch.empty(0, dtype=torch.int64, device=points.device)
    low, high = points.amin(dim=0), points.amax(dim=0)
    cells = in_float64(points - low) / in_float64(high - low).clamp_min(1e-30) * (2**BITS - 1)
    x, y, z = (_spread(axis) for axis in cells.to(torch.int64).unbind(-1))
    return torch.argsort(x | (y << 1) | (z << 2), stable=True).to(points.device)


def _spread(values: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
    """Two zero bits between every two bits of a 21-bit number."""
    for shift, mask in _SPREAD:
        values = (values | (values << shift)) & mask
    return values
