"""Real spherical harmonics to band 3, in the order and with the signs that the field's files use.

Band l holds m = -l .. l. Each function carries the Condon-Shortley sign (-1)^m, so band 1 is (-y, z, -x) times
sqrt(3 / 4 pi); the polynomials hold for unit directions (docs/math.md, eq. 17; Sloan 2013, "Efficient Spherical
Harmonic Evaluation").
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check

MAX_DEGREE = 3

C0 = math.sqrt(1 / math.pi) / 2
C1 = math.sqrt(3 / math.pi) / 2
C2_XY = math.sqrt(15 / math.pi) / 2
C2_ZZ = math.sqrt(5 / math.pi) / 4
C2_XX = math.sqrt(15 / math.pi) / 4
C3_XXX = math.sqrt(35 / (2 * math.pi)) / 4
C3_XYZ = math.sqrt(105 / math.pi) / 2
C3_XZZ = math.sqrt(21 / (2 * math.pi)) / 4
C3_ZZZ = math.sqrt(7 / math.pi) / 4
C3_XXZ = math.sqrt(105 / math.pi) / 4


def basis(directions: Float[Tensor, "*N 3"], degree: int) -> Float[Tensor, "*N K"]:
    """Y_0 .. Y_{K-1} of unit directions, K = (degree + 1)². Raises UsageError for a degree outside 0-3."""
    check.within("sh_degree", degree, 0, MAX_DEGREE, "Bands 0 to 3 are supported.")
    x, y, z = directions.unbind(-1)
    bands = [torch.full_like(x, C0)]
    if degree >= 1:
        bands += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        bands += [
            C2_XY * x * y,
            -C2_XY * y * z,
            C2_ZZ * (2 * z * z - x * x - y * y),
            -C2_XY * x * z,
            C2_XX * (x * x - y * y),
        ]
    if degree >= 3:
        bands += [
            -C3_XXX * y * (3 * x * x - y * y),
            C3_XYZ * x * y * z,
            -C3_XZZ * y * (4 * z * z - x * x - y * y),
            C3_ZZZ * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -C3_XZZ * x * (4 * z * z - x * x - y * y),
            C3_XXZ * z * (x * x - y * y),
            -C3_XXX * x * (x * x - 3 * y * y),
        ]
    return torch.stack(bands, dim=-1)


def evaluate(
    sh0: Float[Tensor, "N 1 3"], shN: Float[Tensor, "N K-1 3"], directions: Float[Tensor, "N 3"], degree: int
) -> Float[Tensor, "N 3"]:
    """max(0, 0.5 + sum_k sh_k Y_k(d)) for unit directions; bands above `degree` or not stored are left out."""
    stored = round(math.sqrt(shN.shape[1] + 1)) - 1
    Y = basis(directions, min(degree, stored))
    coefficients = torch.cat([sh0, shN[:, : Y.shape[-1] - 1]], dim=1)
    return (0.5 + (Y[..., None] * coefficients).sum(dim=-2)).clamp_min(0)


def sh0_from_rgb(rgb: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """The band-0 coefficients that show `rgb` from every side."""
    return (rgb - 0.5) / C0


def rgb_from_sh0(sh0: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
    """Inverse of `sh0_from_rgb` (not clamped)."""
    return sh0 * C0 + 0.5


def turned(shN: Float[Tensor, "N K-1 3"], axes: Float[Tensor, "3 3"]) -> Float[Tensor, "N K-1 3"]:
    """Coefficients of bands 1 and up after space was turned or mirrored: the color seen from `axes @ d` is the former
    color from d. `axes` is orthogonal.

    The functions of one band span the same space in any frame, so its matrix follows from their values at more
    directions than coefficients.
    """
    degree = round(math.sqrt(shN.shape[1] + 1)) - 1
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(64, 3, generator=generator, dtype=torch.float64), dim=1)
    before, after = basis(directions, degree), basis(directions @ axes.double().T, degree)
    out = torch.empty_like(shN)
    for band in range(1, degree + 1):
        rows = slice(band * band, (band + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, rows], before[:, rows]).solution
        stored = slice(rows.start - 1, rows.stop - 1)
        out[:, stored] = torch.einsum("ij,njc->nic", matrix.to(shN), shN[:, stored])
    return out
