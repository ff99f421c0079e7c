"""Tensors as kernels take them: float32, dense, and gradients in memory that is used again."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.raster.backend import Gradients


def overwritable(gaussians: Gaussians, absgrad: bool, bands: bool, spent: Gradients | None) -> Gradients:
    """`spent` where its tensors fit, else uninitialized ones."""
    if (
        spent is not None
        and spent.means.shape == gaussians.means.shape
        and (spent.means2d_abs is not None) == absgrad
        and (spent.shN is not None and spent.shN.shape == gaussians.shN.shape if bands else spent.shN is None)
    ):
        return spent
    n = len(gaussians)
    empty: dict[str, Any] = {
        name: torch.empty_like(tensor) for name, tensor in gaussians.items() if bands or name != "shN"
    }
    means2d, means2d_abs = gaussians.means.new_empty(n, 2), gaussians.means.new_empty(n, 2) if absgrad else None
    return Gradients(**{"shN": None, **empty}, means2d=means2d, means2d_abs=means2d_abs)


def as_float32(gaussians: Gaussians) -> Gaussians:
    """The same record where that is what it holds."""
    if all(t.dtype == torch.float32 and t.is_contiguous() and not t.requires_grad for _, t in gaussians.items()):
        return gaussians
    return Gaussians(**{name: tensor.detach().float().contiguous() for name, tensor in gaussians.items()})


def contiguous(tensor: Tensor | None) -> Tensor | None:
    return None if tensor is None else tensor.detach().float().contiguous()
