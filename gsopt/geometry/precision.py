"""float64 beside a GPU of Apple, which has none."""

from __future__ import annotations

import torch
from torch import Tensor


def widest(device: torch.device) -> torch.dtype:
    """The widest numbers of a device: what sums over many Gaussians or pixels are made in, where they lie."""
    return torch.float32 if device.type == "mps" else torch.float64


def in_float64(tensor: Tensor) -> Tensor:
    """The same numbers in float64, on the CPU where their device has none: for results that float32 would spoil."""
    return (tensor.cpu() if widest(tensor.device) != torch.float64 else tensor).double()
