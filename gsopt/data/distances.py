"""Distances in a grid of cells."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Int16
from torch import Tensor

from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.cpu_backend import workspace

FAR_SQUARED = 1 << 13
"""Squared distance beyond everything, cells; twice that still fits 16 bits."""


def squared_distance(cells: Bool[Tensor, "X Y Z"], reach: int) -> Int16[Tensor, "X Y Z"]:
    """Squared distance to the nearest true cell, exact within `reach` cells along each axis, FAR_SQUARED beyond."""
    squared = torch.empty(cells.shape, dtype=torch.int16)
    most = min(reach, math.isqrt(FAR_SQUARED))
    _cpu.squared_distance(workspace(1), cells.contiguous().view(torch.uint8), most, squared)
    return squared
