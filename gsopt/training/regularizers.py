"""Gradients of the terms beside the photometric loss, in closed form (their values: gsopt/losses.py)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.gaussians import Gaussians

# What a left-out Gaussian's logit becomes: an opacity of 4e-44, which every backend culls.
ABSENT = -100.0
# Upper bound of an opacity raised by dropout: its logit must stay finite.
OPAQUE = 0.999


def alpha_gradient(alphas: Float[Tensor, "H W"], target: Float[Tensor, "H W"], weight: float) -> Float[Tensor, "H W"]:
    """d/dalphas of weight · mean|alphas - target|."""
    return torch.sub(alphas, target).sign_().mul_(weight / alphas.numel())


def add_opacity_gradient(
    v_logit_opacities: Float[Tensor, "N"], logit_opacities: Float[Tensor, "N"], weight: float
) -> None:
    """Add d/dlogit of weight · mean(o): weight/N · o (1 - o), in place."""
    opacities = torch.sigmoid(logit_opacities)
    v_logit_opacities.addcmul_(opacities, 1 - opacities, value=weight / max(1, opacities.numel()))


def add_scale_gradient(v_log_scales: Float[Tensor, "N 3"], log_scales: Float[Tensor, "N 3"], weight: float) -> None:
    """Add d/dlog_scales of weight · mean(scales): weight/(3N) · scales, in place."""
    v_log_scales.add_(log_scales.exp(), alpha=weight / max(1, log_scales.numel()))


@dataclass(frozen=True)
class Dropout:
    """Which Gaussians a step draws; their opacity is divided by the share kept (DropGaussian, Park et al. 2025)."""

    kept: Bool[Tensor, "N"]
    keep_probability: float

    @staticmethod
    def draw(count: int, rate: float, generator: torch.Generator) -> Dropout:
        """Leave each of `count` Gaussians out with probability `rate`."""
        return Dropout(torch.rand(count, generator=generator) >= rate, 1 - rate)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians as drawn: o' = min(o / keep_probability, 0.999), or nothing."""
        raised = (gaussians.opacities / self.keep_probability).clamp_(1e-30, OPAQUE)
        absent = torch.full_like(raised, ABSENT)
        return replace(gaussians, logit_opacities=torch.where(self.kept, torch.logit(raised), absent))

    def chain(self, v_logit_opacities: Float[Tensor, "N"], logit_opacities: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """From the gradient at the drawn logit to that at the stored one.

        With o' = o/k: dlogit'/dlogit = o(1-o)/k / (o'(1-o')) = (1-o)/(1-o'). Zero where left out or clamped.
        """
        opacities = torch.sigmoid(logit_opacities)
        raised = opacities / self.keep_probability
        passes = self.kept & (raised < OPAQUE)
        return torch.where(passes, v_logit_opacities * (1 - opacities) / (1 - raised), torch.zeros_like(raised))
