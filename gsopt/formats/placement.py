"""Splats under a similarity: turned or mirrored, scaled alike in all axes, moved; and parts of a file put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.quats import from_rotation_matrices, multiply

_BLOCK = 1 << 14
"""Rows that are placed at a time, in float64."""


def similarity_parts(linear: Float[Tensor, "3 3"]) -> tuple[float, Float[Tensor, "3 3"]] | None:
    """(scale, orthogonal matrix) with linear = scale * orthogonal, or None where axes shear or scale differently."""
    scale = float(linear.double().square().sum() / 3) ** 0.5
    if not 1e-12 < scale < 1e12:
        return None
    axes = linear.double() / scale
    exact = torch.allclose(axes @ axes.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-4)
    return (scale, axes) if exact else None


def placed(
    gaussians: Gaussians, scale: float, axes: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]
) -> Gaussians:
    """The same splats with means scale * axes @ m + translation; colors turn with them.

    A mirror keeps every covariance R D² Rᵀ when R becomes -axes R, which is a rotation again.
    """
    proper = axes if float(torch.linalg.det(axes)) > 0 else -axes
    turn = from_rotation_matrices(proper.double())
    means, quats, shN = (torch.empty_like(old) for old in (gaussians.means, gaussians.quats, gaussians.shN))
    for start in range(0, len(gaussians), _BLOCK):
        rows = slice(start, start + _BLOCK)
        old = gaussians.quats[rows].double()
        means[rows] = (gaussians.means[rows].double() @ (scale * axes.double()).T + translation.double()).to(means)
        quats[rows] = multiply(turn.expand(len(old), 4), old).to(quats)
        shN[rows] = sh.turned(gaussians.shN[rows], axes)
    log_scales = gaussians.log_scales + torch.tensor(scale).log().to(gaussians.log_scales)
    return replace(gaussians, means=means, quats=quats, log_scales=log_scales, shN=shN)


def joined(parts: list[Gaussians]) -> Gaussians:
    """All splats of one or more parts, with the bands of the highest degree among them; empties the list.

    The bands that a part lacks are zeros that nobody writes, for which the system takes no memory.
    """
    if len(parts) == 1:
        return parts.pop()
    count, bands = sum(map(len, parts)), max(part.shN.shape[1] for part in parts)
    whole = Gaussians(
        **{name: torch.empty(count, *tensor.shape[1:]) for name, tensor in parts[0].items() if name != "shN"},
        shN=torch.from_numpy(np.zeros((count, bands, 3), np.float32)),
    )
    end = count
    while parts:
        part = parts.pop()
        begin = end - len(part)
        for name, tensor in part.items():
            rows = getattr(whole, name)[begin:end]
            (rows[:, : tensor.shape[1]] if name == "shN" else rows).copy_(tensor)
        end = begin
    return whole
