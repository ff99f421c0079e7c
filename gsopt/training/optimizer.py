"""Gaussians with the moments of Adam, and one optimizer step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsopt.config.train import OptimizerConfig
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import AdamStep, Backend, Gradients, RasterSettings


@dataclass(frozen=True)
class OptimizedGaussians:
    """N Gaussians and Adam's two moments of every parameter: rows stay together. Tensors are updated in place."""

    gaussians: Gaussians
    exp_avg: Gaussians
    """Running mean of the gradient, shaped like the parameters."""
    exp_avg_sq: Gaussians
    """Running mean of the squared gradient."""
    steps: dict[str, int]
    """Adam steps taken per parameter; shN takes none while only band 0 is drawn."""

    @staticmethod
    def start(gaussians: Gaussians) -> OptimizedGaussians:
        """Fresh moments; the parameters are copied, so the caller's record is left alone."""
        owned = Gaussians(**{name: tensor.detach().clone().contiguous() for name, tensor in gaussians.items()})
        return OptimizedGaussians(owned, zeros_like(owned), zeros_like(owned), dict.fromkeys(PARAMETERS, 0))

    def __len__(self) -> int:
        return len(self.gaussians)

    def select(self, rows: Tensor) -> OptimizedGaussians:
        """The rows named by a boolean mask or by indices, moments included."""
        return replace(
            self,
            gaussians=self.gaussians.select(rows),
            exp_avg=self.exp_avg.select(rows),
            exp_avg_sq=self.exp_avg_sq.select(rows),
        )

    def append(self, new: Gaussians) -> OptimizedGaussians:
        """These rows, then new ones without a past: their moments are zero."""
        return replace(
            self,
            gaussians=self.gaussians.append(new),
            exp_avg=self.exp_avg.append(zeros_like(new)),
            exp_avg_sq=self.exp_avg_sq.append(zeros_like(new)),
        )

    def forget(self, rows: Tensor, names: tuple[str, ...] = PARAMETERS) -> None:
        """Zero the moments of these rows, in place."""
        for moments in (self.exp_avg, self.exp_avg_sq):
            for name in names:
                getattr(moments, name)[rows] = 0


def zeros_like(gaussians: Gaussians) -> Gaussians:
    """A record of the same shapes, all zero."""
    return Gaussians(**{name: torch.zeros_like(tensor) for name, tensor in gaussians.items()})


def learning_rates(config: OptimizerConfig, lr_means: float, share: float = 1.0) -> dict[str, float]:
    """Rate of every parameter, `share` of what is configured; that of the means comes from the schedule as it is."""
    rates = {name: share * float(getattr(config, f"lr_{name}")) for name in PARAMETERS}
    return {**rates, "means": lr_means}


def adam_step(
    model: OptimizedGaussians,
    gradients: Gradients,
    rates: dict[str, float],
    config: OptimizerConfig,
    backend: Backend,
    camera: Cameras,
    settings: RasterSettings,
) -> None:
    """One Adam step of every parameter, in place, for gradients of a frame that `camera` drew with `settings`.

    While only band 0 is drawn shN has no gradient and is left out: 45 of a Gaussian's 59 numbers.
    """
    lr = {name: rate for name, rate in rates.items() if name != "shN" or settings.sh_degree > 0}
    for name in lr:
        model.steps[name] += 1
    step = AdamStep(lr, model.steps, config.beta1, config.beta2, config.eps)
    backend.adam(model.gaussians, gradients, model.exp_avg, model.exp_avg_sq, step, camera, settings)
