"""One shape of a library: what fills its box, in coarse colors, and what is known about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

SIDE = 48
"""Voxels along each side of the box: the box is not a cube, so its voxels are none either."""
COLOR_SIDE = 12
"""Cells of color along each side of the box."""
MAX_TEXT_LENGTH = 400
"""Longest name, category, license and creator, and longest list of words, characters."""


@dataclass(frozen=True)
class Shape:
    """Solid voxels in a box whose z axis is up."""

    occupied: Bool[np.ndarray, "s s s"]
    colors: UInt8[np.ndarray, "c c c 3"]
    """Mean color of the surface in each cell; black where there is none."""
    sizes: Float32[np.ndarray, "3"]
    """Sides of the box, the longest 1."""


@dataclass(frozen=True)
class Entry:
    """The texts about a shape; every text may be empty but `id`."""

    id: str
    name: str = ""
    """The object in a noun or two: "coffee cup"."""
    category: str = ""
    words: str = ""
    """Further words that should find it: kinds, parts, materials."""
    license: str = ""
    creator: str = ""

    @property
    def title(self) -> str:
        return self.name or self.id
