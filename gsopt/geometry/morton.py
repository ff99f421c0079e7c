"""Z-order: a walk through space along which neighbors mostly stay neighbors (Morton 1966)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

_BITS = 21
"""Per axis: three axes fill 63 bits."""


def morton_order(points: Float[np.ndarray, "N 3"]) -> NDArray[np.int64]:
    """Indices that sort `points` along a Z-curve through their bounding box; ties keep their order."""
    if len(points) == 0:
        return np.empty(0, np.int64)
    low = points.min(axis=0).astype(np.float64)
    extent = points.max(axis=0) - low
    cells = (points - low) / np.where(extent > 0, extent, 1.0) * ((1 << _BITS) - 1)
    spread = _every_third_bit(cells.astype(np.uint64))
    return np.argsort(spread[:, 0] << np.uint64(2) | spread[:, 1] << np.uint64(1) | spread[:, 2], kind="stable")


def _every_third_bit(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Bit i moved to bit 3 i, by halving the groups that move together."""
    steps = (
        (32, 0x001F00000000FFFF),
        (16, 0x001F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
    for shift, mask in steps:
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
