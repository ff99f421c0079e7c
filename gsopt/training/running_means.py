"""Running means of loss and error over steps, for display: nothing is decided by them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.training.targets import Target

PSNR_EVERY = 10
"""Steps between two measurements of the mean squared error, which costs a pass over the image."""
NEW_VALUE_SHARE = 0.05


@dataclass
class RunningMeans:
    """Loss and mean squared error; absent (None) before the first value."""

    loss: float | None = None
    mse: float | None = None

    @property
    def psnr(self) -> float | None:
        """dB, from the running mean squared error over the input views as they were drawn; capped at 100."""
        return None if self.mse is None else -10 * math.log10(max(self.mse, 1e-10))

    def update(self, step: int, loss: float, rendered: Float[Tensor, "H W 3"], target: Target) -> None:
        self.loss = _mixed(self.loss, loss)
        if step % PSNR_EVERY == 1:
            self.mse = _mixed(self.mse, target.share * float(torch.nn.functional.mse_loss(rendered, target.colors)))


def _mixed(mean: float | None, new: float) -> float:
    return new if mean is None else (1 - NEW_VALUE_SHARE) * mean + NEW_VALUE_SHARE * new
