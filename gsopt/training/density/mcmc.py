"""Gaussians as samples of a Markov chain (Kheradmand et al. 2024): relocate the dead, grow to a budget, add noise."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.geometry.precision import in_float64
from gsopt.raster.backend import Gradients
from gsopt.training.optimizer import OptimizedGaussians
from gsopt.training.plan import DensityPlan
from gsopt.training.randomness import normal
from gsopt.training.schedule import Schedule

# Noise is scaled by sigmoid(-STEEPNESS (o - HALF)): only nearly transparent Gaussians wander (the authors' constants).
STEEPNESS = 100.0
HALF = 0.005
# Above this opacity that factor is below 1e-4 and no noise is drawn: the move would be far below Adam's own.
STEADY = 0.1
# One Gaussian stands for at most this many copies in one relocation (the authors' constant).
MAX_COPIES = 51
OPAQUE = 1 - 1e-7

Columns = tuple[Tensor, Tensor, Tensor]
"""x, y and z of M vectors."""


class Mcmc:
    """Never prunes: what is transparent is moved on top of what is not, without changing the image."""

    def __init__(self, plan: DensityPlan, schedule: Schedule, generator: torch.Generator) -> None:
        self._plan = plan
        self._schedule = schedule
        self._generator = generator

    def watches(self, step: int, count: int) -> bool:
        """Needs no statistics."""
        return False

    def after_backward(self, gradients: Gradients, radii: Int[Tensor, "N 2"], width: int, height: int) -> None:
        """Nothing to note."""

    def after_step(self, model: OptimizedGaussians, lr_means: float) -> None:
        """Stochastic gradient Langevin dynamics: means += lr · noise_lr · sigmoid(-100 (o - 0.005)) · Σ ξ (eq. 10)."""
        gaussians = model.gaussians
        rows = torch.nonzero(gaussians.logit_opacities < math.log(STEADY / (1 - STEADY)))[:, 0]
        if len(rows) == 0:
            return
        opacities = torch.sigmoid(gaussians.logit_opacities.index_select(0, rows))
        mobility = torch.sigmoid((HALF - opacities) * STEEPNESS)
        xi = normal(3, len(rows), generator=self._generator, device=rows.device)
        xi *= mobility * (self._plan.noise_lr * lr_means)
        moves = spread(gaussians.quats.index_select(0, rows), gaussians.log_scales.index_select(0, rows), xi)
        gaussians.means.index_copy_(0, rows, moves.add_(gaussians.means.index_select(0, rows)))

    def refine(self, step: int, model: OptimizedGaussians) -> OptimizedGaussians:
        """Move the dead, then grow by a fixed share."""
        if not self._schedule.refines(step):
            return model
        self._relocate(model)
        return self._grow(model)

    def select(self, rows: Tensor) -> None:
        """Nothing to follow."""

    def tensors(self) -> dict[str, Tensor]:
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Nothing to take back."""

    def _relocate(self, model: OptimizedGaussians) -> None:
        """Move every Gaussian at or below prune_opacity onto one drawn by opacity; in place."""
        opacities = model.gaussians.opacities
        dead = torch.nonzero(opacities <= self._plan.prune_opacity)[:, 0]
        if len(dead) in (0, len(model)):
            return
        weights = torch.where(opacities > self._plan.prune_opacity, opacities, 0.0)
        sources = draw(weights, len(dead), self._generator)
        self._share(model, sources)
        for _, tensor in model.gaussians.items():
            tensor[dead] = tensor[sources]
        model.forget(dead)

    def _grow(self, model: OptimizedGaussians) -> OptimizedGaussians:
        """Add copies of Gaussians drawn by opacity, up to growth · N or the budget."""
        target = min(self._plan.max_gaussians, int(self._plan.growth * len(model)))
        if target <= len(model):
            return model
        sources = draw(model.gaussians.opacities, target - len(model), self._generator)
        self._share(model, sources)
        return model.append(model.gaussians.select(sources))

    def _share(self, model: OptimizedGaussians, sources: Int[Tensor, "M"]) -> None:
        """Make every source as faint and as small as if it and its copies drew what it drew alone; in place."""
        copies = torch.bincount(sources, minlength=len(model)) + 1
        rows = torch.nonzero(copies > 1)[:, 0]
        opacities, shrink = shared(model.gaussians.opacities[rows], copies[rows])
        opacities = opacities.clamp(self._plan.prune_opacity, OPAQUE)
        model.gaussians.logit_opacities[rows] = torch.logit(opacities).to(model.gaussians.logit_opacities)
        model.gaussians.log_scales[rows] += shrink.log().to(model.gaussians.log_scales)[:, None]
        model.forget(rows)


def shared(opacities: Float[Tensor, "M"], copies: Int[Tensor, "M"]) -> tuple[Float[Tensor, "M"], Float[Tensor, "M"]]:
    """Opacity of n coinciding copies of one Gaussian, and the factor on its scales (eq. 9); float64.

    o' = 1 - (1 - o)^(1/n), and the factor is o / Σ_{j=1..n} C(n, j) (-1)^(j-1) o'^j / √j: the paper's double sum over
    i and k with Σ_i C(i-1, k) = C(n, k+1) carried out, j = k + 1.
    """
    n = in_float64(copies.clamp_max(MAX_COPIES))
    o = in_float64(opacities).clamp_max(OPAQUE)
    new = 1 - (1 - o) ** (1 / n)
    total = torch.zeros_like(o)
    term = torch.full_like(o, -1.0)
    for j in range(1, int(n.max()) + 1 if len(n) else 1):
        term = -term * new * (n - j + 1).clamp_min(0) / j  # (-1)^(j-1) C(n, j) o'^j, zero for j > n
        total += term / math.sqrt(j)
    return new, o / total


def spread(
    quats: Float[Tensor, "M 4"], log_scales: Float[Tensor, "M 3"], vectors: Float[Tensor, "3 M"]
) -> Float[Tensor, "M 3"]:
    """Σ v = R S² Rᵀ v. It runs in every step, so R is never built: Rᵀ v is v turned by the inverse quaternion."""
    w, x, y, z = quats.T.contiguous()
    norm = (w * w + x * x + y * y + z * z).sqrt_()
    w, axis = w / norm, (x / norm, y / norm, z / norm)
    local = turned(-w, axis, (vectors[0], vectors[1], vectors[2]))
    variances = log_scales.T.contiguous().mul_(2).exp_()
    a, b, c = (length * variance for length, variance in zip(local, variances, strict=True))
    return torch.stack(turned(w, axis, (a, b, c)), dim=1)


def turned(w: Tensor, axis: Columns, v: Columns) -> Columns:
    """v turned by the unit quaternion (w, axis): v + w t + axis × t with t = 2 axis × v; columns of length M."""
    tx, ty, tz = (2 * part for part in _cross(axis, v))
    cx, cy, cz = _cross(axis, (tx, ty, tz))
    return v[0] + w * tx + cx, v[1] + w * ty + cy, v[2] + w * tz + cz


def _cross(a: Columns, b: Columns) -> Columns:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def draw(weights: Float[Tensor, "N"], count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Rows drawn with replacement in proportion to their weights (any N, unlike torch.multinomial)."""
    cumulative = weights.cpu().double().cumsum(0)  # a GPU adds up in an order of its own
    points = torch.rand(count, dtype=torch.float64, generator=generator) * cumulative[-1]
    return torch.searchsorted(cumulative, points, right=True).clamp_max(len(weights) - 1).to(weights.device)
