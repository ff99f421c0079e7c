"""Adaptive density control (Kerbl et al. 2023, section 5): split, prune and reset, within a budget.

The published rule clones small Gaussians and splits large ones at random; here all split alike, along the longest axis
(Deng et al. 2025, "Improving Densification in 3D Gaussian Splatting"), so that the halves look like the whole at first.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import quats as quaternions
from gsopt.raster.backend import Gradients
from gsopt.training.density import at_least_one, is_full
from gsopt.training.optimizer import OptimizedGaussians
from gsopt.training.plan import DensityPlan
from gsopt.training.schedule import Schedule

# A half along the axis that is split, and the distance of its center from the whole's: shares of the whole's scale.
HALF_LENGTH, HALF_DISTANCE = 0.6, 0.8
CPU = torch.device("cpu")


class Adc:
    """Grows where the image pulls hard on a projected center, prunes what is transparent or too large."""

    def __init__(self, plan: DensityPlan, schedule: Schedule, count: int, device: torch.device = CPU) -> None:
        self._plan = plan
        self._schedule = schedule
        self._device = device
        self._forget(count)

    def _forget(self, count: int) -> None:
        self.grad_sum = torch.zeros(count, device=self._device)
        """Sum over views of |dLoss/dmean2d| in normalized device coordinates."""
        self.seen = torch.zeros(count, dtype=torch.int32, device=self._device)
        """Number of views in which the Gaussian was drawn."""

    def watches(self, step: int, count: int) -> bool:
        """True when the next refinement will have room to grow into, or make some."""
        due = self._schedule.next_refinement(step)
        return due is not None and (not is_full(count, self._plan) or self._makes_room(due))

    def _makes_room(self, step: int) -> bool:
        return self._plan.turnover > 0 and self._schedule.turns_over(step)

    def after_backward(self, gradients: Gradients, radii: Int[Tensor, "N 2"], width: int, height: int) -> None:
        """Accumulate the gradient of the projected centers. Rows that were not drawn have none and are not counted."""
        v = gradients.means2d_abs if gradients.means2d_abs is not None else gradients.means2d
        self.grad_sum += torch.hypot(v[:, 0] * (0.5 * width), v[:, 1] * (0.5 * height))
        self.seen += radii[:, 0] > 0

    def after_step(self, model: OptimizedGaussians, lr_means: float) -> None:
        """Nothing to do between refinements."""

    def refine(self, step: int, model: OptimizedGaussians) -> OptimizedGaussians:
        """Grow, prune and start the statistics afresh; lower all opacities when a reset is due."""
        if self._schedule.refines(step):
            model = self._grow_and_prune(step, model)
            self._forget(len(model))
        if self._schedule.resets(step):
            lower_opacities(model, 2 * self._plan.prune_opacity)
        return model

    def select(self, rows: Tensor) -> None:
        self.grad_sum, self.seen = self.grad_sum[rows], self.seen[rows]

    def tensors(self) -> dict[str, Tensor]:
        return {"grad_sum": self.grad_sum, "seen": self.seen}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        self.grad_sum, self.seen = (tensors[name].to(self._device) for name in ("grad_sum", "seen"))

    def _grow_and_prune(self, step: int, model: OptimizedGaussians) -> OptimizedGaussians:
        """Split what stays where its mean gradient is above the threshold. A set that stays full is left alone."""
        gaussians = model.gaussians
        keep = at_least_one(self._keep(step, gaussians), gaussians.logit_opacities)
        if is_full(int(keep.sum()), self._plan):
            return model
        scores = self.grad_sum / self.seen.clamp_min(1)
        room = max(0, self._plan.max_gaussians - len(model))
        splitting = best((scores > self._plan.grow_grad2d) & keep, scores, room)
        return model.select(keep & ~splitting).append(split(gaussians.select(splitting)))

    def _keep(self, step: int, gaussians: Gaussians) -> Bool[Tensor, "N"]:
        """Neither transparent nor, once opacities were reset, huge."""
        keep = gaussians.opacities >= self._plan.prune_opacity
        if self._schedule.prunes_large(step):
            keep &= largest_scales(gaussians) <= self._plan.prune_scale
        return keep


def best(chosen: Bool[Tensor, "N"], scores: Float[Tensor, "N"], room: int) -> Bool[Tensor, "N"]:
    """`chosen`, cut down to the `room` highest scores where it is more; equal scores in row order."""
    if int(chosen.sum()) <= room:
        return chosen
    ranked = torch.argsort(torch.where(chosen, scores, -1.0), descending=True, stable=True)
    kept = torch.zeros_like(chosen)
    kept[ranked[:room]] = True
    return kept


def largest_scales(gaussians: Gaussians) -> Float[Tensor, "N"]:
    """Standard deviation along the longest axis, scene units."""
    return gaussians.log_scales.amax(dim=1).exp()


def split(gaussians: Gaussians) -> Gaussians:
    """Two halves for each one, side by side along its longest axis; all first halves, then all second ones."""
    longest = gaussians.log_scales.argmax(dim=1, keepdim=True)
    along = HALF_DISTANCE * gaussians.log_scales.gather(1, longest).exp()
    local = torch.zeros_like(gaussians.means).scatter(1, longest, along)
    offsets = (quaternions.rotation_matrices(gaussians.quats) @ local[..., None])[..., 0]
    shrunk = torch.zeros_like(local).scatter(1, longest, math.log(HALF_LENGTH))
    first = replace(gaussians, means=gaussians.means + offsets, log_scales=gaussians.log_scales + shrunk)
    return first.append(replace(first, means=gaussians.means - offsets))


def lower_opacities(model: OptimizedGaussians, opacity: float) -> None:
    """Cap every opacity, in place, and forget its moments: what the images need comes back, the rest is pruned."""
    model.gaussians.logit_opacities.clamp_max_(math.log(opacity / (1 - opacity)))
    model.exp_avg.logit_opacities.zero_()
    model.exp_avg_sq.logit_opacities.zero_()
