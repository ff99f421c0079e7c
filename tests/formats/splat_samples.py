"""Splats to write and read, and comparisons of two of them."""

from __future__ import annotations

import importlib.util
import struct
from dataclasses import dataclass

import numpy as np
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


def ksplat(level: int, count: int, degree: int, half_range: int = 32767) -> bytes:
    """A .ksplat of one section, put together from its layout: buckets of 2, the last one partly filled.

    Splat i lies at (i + 0.5, -i, 0.25), has scales e^-1 and 1, the rotation (1, 0, 0, -1), color (255, 0, 51), opacity
    0.2, and the coefficient k / 64 for the k-th value of its harmonics in the file.
    """
    rest = 3 * ((degree + 1) ** 2 - 1)
    full, partial = count // 2, count % 2
    real, harmonic = ("<f4", "<f4") if level == 0 else ("<f2", ("<f2", "u1")[level - 1])
    row = np.dtype(
        [
            ("mean", "<f4" if level == 0 else "<u2", 3),
            ("scale", real, 3),
            ("quat", real, 4),
            ("rgba", "u1", 4),
            ("rest", harmonic, rest),
        ]
    )
    rows = np.zeros(count, row)
    means = np.array([(i + 0.5, -i, 0.25) for i in range(count)])
    centers = means[::2].astype("<f4")
    block = 4.0
    steps = (means - centers[np.arange(count) // 2]) / (block / 2) * half_range + half_range
    rows["mean"] = means if level == 0 else np.round(steps)
    rows["scale"] = [np.exp(-1), 1, 1]
    rows["quat"] = [1, 0, 0, -1]
    rows["rgba"] = [255, 0, 51, 51]
    values = np.arange(rest) / 64
    rows["rest"] = np.round((values + 1.5) / 3 * 255) if level == 2 else values
    header = bytearray(4096)
    struct.pack_into("<BB2xIIIIH", header, 0, 0, 1, 1, 1, count, count, level)
    struct.pack_into("<ff", header, 36, -1.5, 1.5)
    section = bytearray(1024)
    struct.pack_into("<IIIIfH2xI", section, 0, count, count, 2, full + partial, block, 12, half_range)
    struct.pack_into("<IIH", section, 32, full, partial, degree)
    sizes = np.full(partial, 1, "<u4")
    return bytes(header + section) + sizes.tobytes() + centers.tobytes() + rows.tobytes()
