"""Splats to write and read, and comparisons of two of them."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import torch
from torch import Tensor

from gsopt.formats import SUFFIXES
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import normalize

WRITABLE = tuple(s for s in SUFFIXES if not s.startswith(".usd") or importlib.util.find_spec("pxr"))
"""Formats that can be written here: USD needs usd-core."""


def make_splats(count: int = 300, degree: int = 3, seed: int = 0) -> Gaussians:
    """Random splats inside the range that every format holds without clamping."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator) * (high - low) + low

    return Gaussians(
        means=uniform(-5, 5, count, 3),
        quats=torch.randn(count, 4, generator=generator) * uniform(0.1, 10, count, 1),
        log_scales=uniform(-8, 2, count, 3),
        logit_opacities=uniform(-6, 6, count),
        sh0=uniform(-1.7, 1.7, count, 1, 3),
        shN=uniform(-0.9, 0.9, count, (degree + 1) ** 2 - 1, 3),
    )


def same_bits(a: Gaussians, b: Gaussians) -> bool:
    """Equal shapes and equal bits, so that -0.0 and 0.0 differ."""
    return all(
        x.dtype == y.dtype == torch.float32 and torch.equal(x.view(torch.int32), y.view(torch.int32))
        for (_, x), (_, y) in zip(a.items(), b.items(), strict=True)
    )


@dataclass(frozen=True)
class Errors:
    """Largest absolute difference of each quantity."""

    means: float
    log_scales: float
    opacities: float
    sh0: float
    sh1: float
    sh_rest: float
    quats: float
    """Largest difference of unit quaternions, up to their sign."""


def errors(a: Gaussians, b: Gaussians) -> Errors:
    """Difference of `b` from `a` per quantity; records of different length cannot be compared."""

    def largest(x: Tensor) -> float:
        return float(x.abs().max()) if x.numel() else 0.0

    p, q = normalize(a.quats.double()), normalize(b.quats.double())
    return Errors(
        means=largest(a.means.double() - b.means),
        log_scales=largest(a.log_scales - b.log_scales),
        opacities=largest(torch.sigmoid(a.logit_opacities.double()) - torch.sigmoid(b.logit_opacities.double())),
        sh0=largest(a.sh0 - b.sh0),
        sh1=largest(a.shN[:, :3] - b.shN[:, :3]),
        sh_rest=largest(a.shN[:, 3:] - b.shN[:, 3:]),
        quats=float(torch.minimum((p - q).abs().amax(dim=1), (p + q).abs().amax(dim=1)).max()),
    )
