"""The check of all splats that are read or written, and conversions that keep values valid."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gsopt.errors import InputError, InputWarning
from gsopt.gaussians import Gaussians

MAX_SH_DEGREE = 3
BANDS = (0, 3, 8, 15)
"""K - 1 for SH degree 0 to 3."""
_XYZ = "xyz"
_TINY = torch.finfo(torch.float32).tiny
_MAX_LOG = 87.0
"""exp(±87) are normal float32 numbers."""
BYTE_OPACITY_MARGIN = 0.25 / 255
"""Distance of the opacities of bytes 0 and 255 from 0 and 1: their logits are finite and round to the same byte."""
_MAX_LOGIT = math.log(1 / BYTE_OPACITY_MARGIN - 1)
"""Stands for an infinite logit, which other tools make of bytes 0 and 255."""


def storable(gaussians: Gaussians, path: Path) -> Gaussians:
    """The Gaussians as float32 on the CPU, detached and checked; every writer starts with them."""
    gaussians = Gaussians(**{name: tensor.detach() for name, tensor in gaussians.items()})
    return checked(gaussians.to("cpu").to(torch.float32), path, "Nothing was written.")


def checked(gaussians: Gaussians, path: Path, consequence: str = "Remove or repair that splat.") -> Gaussians:
    """The same Gaussians; InputError names path, property and row of a value that is not finite or no rotation."""
    _check_shapes(gaussians, path)
    for name, tensor in gaussians.items():
        # Testing every element is slow: do it only when the sum is not finite, because of an element or an overflow.
        if tensor.numel() and not bool(torch.isfinite(tensor.sum())) and not bool(torch.isfinite(tensor).all()):
            row, *column = torch.nonzero(~torch.isfinite(tensor))[0].tolist()
            where = f"`{ply_name(name, column, gaussians.shN.shape[1])}` of row {row}"
            raise InputError(f"{path}: {where} must be finite, got {tensor[(row, *column)].item()}. {consequence}")
    unusable = torch.nonzero(~_has_length(gaussians.quats))
    if len(unusable):
        row = int(unusable[0])
        got = ", ".join(f"{value:g}" for value in gaussians.quats[row].tolist())
        raise InputError(f"{path}: the rotation (rot_0..3) of row {row} has no usable length, got {got}. {consequence}")
    return gaussians


def usable(gaussians: Gaussians, path: Path) -> Gaussians:
    """The splats that can be drawn; readers of every format end with it.

    Infinite logits of opacities become ±6.9. A splat with another value that is not finite, or with a rotation of no
    length, is dropped; one InputWarning counts them. Raises InputError when no splat of the file is left.
    """
    _check_shapes(gaussians, path)
    logits = torch.where(
        gaussians.logit_opacities.isinf(),
        gaussians.logit_opacities.clamp(-_MAX_LOGIT, _MAX_LOGIT),
        gaussians.logit_opacities,
    )
    gaussians = replace(gaussians, logit_opacities=logits)
    good = _has_length(gaussians.quats)
    for _, tensor in gaussians.items():
        if tensor.numel() and not bool(torch.isfinite(tensor.sum())):
            good &= torch.isfinite(tensor.reshape(len(gaussians), -1)).all(dim=1)
    dropped = len(gaussians) - int(good.sum())
    if not dropped:
        return gaussians
    if dropped == len(gaussians):
        raise InputError(f"{path} holds no splat that can be drawn, got {dropped} with NaN. Export it again.")
    warnings.warn(
        f"{path}: {dropped} of {len(gaussians)} splats were left out: a value is not finite, or a rotation has no "
        "length. `--strict` refuses such files.",
        InputWarning,
        stacklevel=3,
    )
    return gaussians.select(good)


def _has_length(quats: Tensor) -> Tensor:
    """[N] True for rotations that can be normalized."""
    length2 = quats.square().sum(dim=1)
    return (length2 >= _TINY) & torch.isfinite(length2)


def _check_shapes(gaussians: Gaussians, path: Path) -> None:
    n, bands = len(gaussians), gaussians.shN.shape[1] if gaussians.shN.ndim == 3 else 0
    expected: dict[str, list[int]] = {"means": [n, 3], "quats": [n, 4], "log_scales": [n, 3], "logit_opacities": [n]}
    expected |= {"sh0": [n, 1, 3], "shN": [n, bands, 3]}
    for name, tensor in gaussians.items():
        if list(tensor.shape) != expected[name]:
            got = list(tensor.shape)
            raise InputError(f"{path}: `{name}` must have shape {expected[name]}, got {got}. Give one row per splat.")
    if bands not in BANDS:
        raise InputError(f"{path}: `shN` must have {BANDS} bands (SH degree 0-3), got {bands}. Call with_sh_degree(3).")


def ply_name(parameter: str, index: list[int], bands: int) -> str:
    """The Inria PLY's name for one column of a parameter, e.g. ("shN", [1, 2], 15) -> "f_rest_31"."""
    if parameter == "means":
        return _XYZ[index[0]]
    if parameter == "shN":
        return f"f_rest_{index[1] * bands + index[0]}"
    if parameter == "sh0":
        return f"f_dc_{index[1]}"
    if parameter == "logit_opacities":
        return "opacity"
    return f"{'rot' if parameter == 'quats' else 'scale'}_{index[0]}"


def logit(opacities: Tensor, quantum: float = 0.0) -> Tensor:
    """ln(p / (1 - p)) of opacities in [0, 1], clamped to `quantum` from both ends, so that it is finite."""
    return torch.logit(opacities.double().clamp(quantum, 1.0 - quantum)).float()


def scales(log_scales: Tensor) -> Tensor:
    """exp(log_scales), clamped to the normal float32 range, so that its logarithm is finite."""
    return log_scales.clamp(-_MAX_LOG, _MAX_LOG).exp()


def log_scales(scales: Tensor) -> Tensor:
    """Natural logarithm of scales; 0 counts as the least normal float32, negative ones give NaN."""
    return torch.where(scales < 0, torch.nan, scales.clamp_min(_TINY)).log()


def opacity_bytes(opacities: Tensor) -> Tensor:
    """Opacities as bytes 1 to 254: other tools turn 0 and 255 into infinite logits."""
    return (opacities * 255).round().clamp(1, 254).to(torch.uint8)


def to_bytes(values: Tensor) -> Tensor:
    """Values rounded and clamped to 0..255."""
    return values.round().clamp(0, 255).to(torch.uint8)
