"""The record of all splats, as Blender stores it: activated, in the frame of the file.

Sums and filters over it are plain numpy; a million rows take some ten milliseconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

Floats = NDArray[np.float32]
BANDS = (0, 3, 8, 15)
"""Coefficients beyond the base color for degree 0 to 3."""
C0 = 0.5 / math.sqrt(math.pi)
"""Value of the spherical harmonic of band 0."""
TINY = float(np.finfo(np.float32).tiny)
LARGEST_LOG = 87.0
"""exp(±87) are normal float32 numbers."""
NEAREST_TO_ONE = float(np.nextafter(np.float32(1), np.float32(0)))
ODD_IN = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""The axes in which each harmonic beyond the base is odd."""


@dataclass(frozen=True)
class Splats:
    """N splats. Positions, scales and rotations are in the frame of the file they came from."""

    positions: Floats
    """[N, 3] scene units."""
    scales: Floats
    """[N, 3] standard deviations along the local axes, scene units."""
    rotations: Floats
    """[N, 4] unit quaternions w, x, y, z."""
    opacities: Floats
    """[N] 0 to 1."""
    base: Floats
    """[N, 3] coefficients of band 0; the color from every side is 0.5 + C0 * base, sRGB-coded."""
    sh: Floats
    """[N, K-1, 3] coefficients of bands 1 and up."""
    left_out: int = 0
    """Rows of the file that cannot be drawn."""

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1] + 1) - 1

    @property
    def colors(self) -> Floats:
        """[N, 3] sRGB-coded base colors, 0 to 1."""
        colors: Floats = np.clip(0.5 + np.float32(C0) * self.base, 0, 1)
        return colors

    def rows(self, chosen: Any) -> Splats:
        """Those rows: a mask, numbers or a slice."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: part[chosen] for name, part in parts.items() if isinstance(part, np.ndarray)})

    def at_most(self, count: int) -> Splats:
        """Every k-th row, so that no more than `count` are left."""
        return self if len(self) <= count else self.rows(slice(None, None, -(-len(self) // max(1, count))))


def from_file_values(
    positions: Floats, log_scales: Floats, quaternions: Floats, logits: Floats, base: Floats, sh: Floats, path: object
) -> Splats:
    """Activated splats from what the files of the field hold. Rows with a value that is not finite or a rotation of no
    length are left out, an infinite logit is an opacity of 0 or 1. InputError when no row is left."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternions, axis=1)
        opacities = (1 / (1 + np.exp(-logits))).astype(np.float32)
        good = (length > 0) & np.isfinite(length)
        for values in (positions, log_scales, opacities, base, sh):
            if values.size and not np.isfinite(values.sum(dtype=np.float64)):
                good &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        scales = np.exp(np.clip(log_scales, -LARGEST_LOG, LARGEST_LOG))
    left_out = len(good) - int(good.sum())
    if left_out and left_out == len(good):
        raise InputError(f"{path} holds no splat that can be drawn, got {left_out} with NaN. Export it again.")
    length[~good] = 1
    found = Splats(positions, scales, quaternions / length[:, None], opacities, base, sh)
    return replace(found.rows(good), left_out=left_out) if left_out else found


def log_scales(splats: Splats) -> Floats:
    """Natural logarithm of the scales; 0 counts as the least normal number."""
    return np.log(np.maximum(splats.scales, TINY))


def logits(splats: Splats) -> Floats:
    """ln(p / (1 - p)), kept finite: 0 and 1 become the nearest numbers between them."""
    p = np.clip(splats.opacities.astype(np.float64), 1e-7, NEAREST_TO_ONE)
    return np.log(p / (1 - p)).astype(np.float32)


def turned(splats: Splats, signs: tuple[int, int, int]) -> Splats:
    """The same splats after the axes with sign -1 were turned around; two of them, or it would be a mirror.

    For S = diag(signs) a position p becomes S p and a rotation R becomes S R S; a harmonic that is odd in an axis
    changes its sign with it.
    """
    x, y, z = signs
    sign = {"x": x, "y": y, "z": z}
    parity = np.array([math.prod(sign[axis] for axis in axes) for axes in ODD_IN[: splats.sh.shape[1]]], np.float32)
    return replace(
        splats,
        positions=splats.positions * np.array(signs, np.float32),
        rotations=splats.rotations * np.array([1, y * z, x * z, x * y], np.float32),
        sh=splats.sh * parity[:, None],
    )
