"""Density control, the number and places of the Gaussians: one protocol, two strategies."""

from __future__ import annotations

from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.raster.backend import Gradients
from gsopt.training.optimizer import OptimizedGaussians
from gsopt.training.plan import DensityPlan
from gsopt.training.schedule import Schedule

FULL = 0.99
"""Share of the budget from which on a set is full: there is no room that would be worth a copy of all rows."""


class DensityControl(Protocol):
    """Watches the steps whose say counts, and now and then changes the set of Gaussians."""

    def watches(self, step: int, count: int) -> bool:
        """True when this step's backward pass has a say in the next change of a set of `count` Gaussians."""
        ...

    def after_backward(self, gradients: Gradients, radii: Int[Tensor, "N 2"], width: int, height: int) -> None:
        """Note what a watched view's backward pass says; image size in px."""
        ...

    def after_step(self, model: OptimizedGaussians, lr_means: float) -> None:
        """Change parameters in place after the optimizer step; `lr_means` in scene units."""
        ...

    def refine(self, step: int, model: OptimizedGaussians) -> OptimizedGaussians:
        """Add and remove Gaussians when this step asks for it; the very same record where rows stay the same."""
        ...

    def select(self, rows: Tensor) -> None:
        """Follow a selection or permutation of the Gaussians."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """The statistics, for a checkpoint."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take the statistics back."""
        ...


def make_density(
    plan: DensityPlan, schedule: Schedule, count: int, generator: torch.Generator, device: torch.device
) -> DensityControl:
    """The run's strategy for `count` first Gaussians on `device`."""
    if plan.strategy == "mcmc":
        from gsopt.training.density.mcmc import Mcmc

        return Mcmc(plan, schedule, generator)
    from gsopt.training.density.adc import Adc

    return Adc(plan, schedule, count, device)


def is_full(count: int, plan: DensityPlan) -> bool:
    """True when `count` Gaussians leave no room worth the work."""
    return count >= FULL * plan.max_gaussians


def at_least_one(keep: Bool[Tensor, "N"], scores: Float[Tensor, "N"]) -> Bool[Tensor, "N"]:
    """`keep`, or only the row of the highest score where nothing would be left: an empty scene learns nothing more."""
    if len(keep) and not bool(keep.any()):
        keep = keep.clone()
        keep[scores.argmax()] = True
    return keep
