"""Splats under a similarity, their colors turned with them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UsageError
from .harmonics import HARMONICS
from .splats import Floats, Splats

_DIRECTIONS = 64
"""Directions in which turned harmonics are compared: a degree has 7 unknowns at most."""
_SHEAR = 1e-4


def placed(splats: Splats, matrix: Any) -> Splats:
    """The same splats in the frame that a [4, 4] matrix leads to. UsageError where it mirrors, shears or stretches."""
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if scale <= 0 or not np.allclose(linear @ linear.T, scale**2 * np.eye(3), rtol=0, atol=_SHEAR * scale**2):
        raise UsageError("The object is mirrored, or scaled differently along its axes. Give it one scale above 0.")
    turn = linear / scale
    return replace(
        splats,
        positions=(splats.positions @ linear.T + matrix[:3, 3]).astype(np.float32),
        scales=(splats.scales * scale).astype(np.float32),
        rotations=product(quaternion(turn), splats.rotations).astype(np.float32),
        sh=turned_harmonics(splats.sh, turn),
    )


def turned_harmonics(sh: Floats, turn: NDArray[np.float64]) -> Floats:
    """[N, K-1, 3] coefficients that show toward d what `sh` showed toward the direction that the turn brings to d.

    A turn mixes the harmonics of one degree only: the mixture is the one that fits a set of directions.
    """
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.array(sh)
    for degree, harmonics in HARMONICS.items():
        band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        if band.stop <= sh.shape[1]:
            new, old = (np.stack(harmonics(*d.T), axis=1) for d in (directions, directions @ turn))
            mixture = np.linalg.lstsq(new, old, rcond=None)[0].astype(np.float32)
            found[:, band] = np.einsum("ij,njc->nic", mixture, sh[:, band])
    return found


def quaternion(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """w, x, y, z of a rotation: an eigenvector, of the largest eigenvalue, of its matrix (Bar-Itzhack 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn
    lower = [[xx + yy + zz, 0, 0, 0], [zy - yz, xx - yy - zz, 0, 0]]
    lower += [[xz - zx, yx + xy, yy - xx - zz, 0], [yx - xy, xz + zx, yz + zy, zz - xx - yy]]
    found: NDArray[np.float64] = np.linalg.eigh(np.array(lower))[1][:, -1]
    return found * math.copysign(1, found[0])


def product(a: NDArray[np.float64], b: Floats) -> NDArray[np.float64]:
    """The product of a and each row of b."""
    w, x, y, z = a
    by_a = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    found: NDArray[np.float64] = b @ by_a.T
    return found
