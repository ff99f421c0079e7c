"""Stops a run whose numbers are no longer numbers. Nothing is repaired: a repaired NaN hides its cause."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from gsopt.errors import NumericalError
from gsopt.training.checkpoint import newest_saved


def require_finite(tensors: Iterable[tuple[str, Tensor]], step: int, checkpoints: Path) -> None:
    """Raise NumericalError naming the first tensor and index that is NaN or infinite."""
    for name, tensor in tensors:
        if tensor.numel() == 0 or all(math.isfinite(end) for end in torch.aminmax(tensor)):  # NaN wins both
            continue
        index = torch.nonzero(~torch.isfinite(tensor))[0].tolist()
        _stop(f"`{name}` became {tensor[tuple(index)].item()} at index {index}", step, checkpoints)


def require_finite_loss(loss: float, view: str, step: int, checkpoints: Path) -> None:
    """Raise NumericalError when the loss of one view is NaN or infinite."""
    if not math.isfinite(loss):
        _stop(f"`loss` became {loss} on view {view}", step, checkpoints)


def _stop(what: str, step: int, checkpoints: Path) -> NoReturn:
    last_good = newest_saved(checkpoints)
    remedy = (
        f"The last good state is {last_good}: lower the learning rates and start again in another folder."
        if last_good
        else "No checkpoint was written yet. Check the poses and the scale of the scene, or lower the learning rates."
    )
    raise NumericalError(f"{what} in step {step}. {remedy}")
