"""Gradients of the terms beside the photometric loss, in closed form (values: tests/training/test_regularizers.py)."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import Gradients
from gsopt.training.randomness import uniform

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


def add_area_gradient(v_log_scales: Float[Tensor, "N 3"], log_scales: Float[Tensor, "N 3"], weight: float) -> None:
    """Add d/dlog_scales of weight · mean(scales²): 2 weight/(3N) · scales², in place."""
    v_log_scales.add_((2 * log_scales).exp(), alpha=2 * weight / max(1, log_scales.numel()))


def weaken_near(gradients: Gradients, means: Float[Tensor, "N 3"], camera: Cameras, distance: float) -> None:
    """Scale the gradients of each Gaussian by min(1, (d / distance)²), d its distance to the camera, in place.

    A place is seen by more pixels the nearer it is, so that Gaussians before a lens, which no other photo sees, take
    the largest share of its gradients and stay there as haze (Philip & Deschaintre 2023, "Floaters No More")."""
    away = means - camera.centers[0].to(means)
    factors = (away.square().sum(1) / distance**2).clamp_(max=1)
    for field in fields(gradients):
        values = getattr(gradients, field.name)
        if values is not None:
            values.mul_(factors.view(-1, *[1] * (values.ndim - 1)))


@dataclass(frozen=True)
class Dropout:
    """A step that draws some Gaussians; their opacity is divided by the share kept (DropGaussian, Park et al. 2025)."""

    drawn: Gaussians
    """With opacities o' = min(o / share, 0.999), or none where left out."""
    slope: Float[Tensor, "N"]
    """dlogit'/dlogit = o(1-o)/share / (o'(1-o')) = (1-o)/(1-o'); zero where left out or clamped."""

    @staticmethod
    def of(gaussians: Gaussians, rate: float, generator: torch.Generator) -> Dropout:
        """Leave each Gaussian out with probability `rate`."""
        opacities = gaussians.opacities
        raised = (opacities / (1 - rate)).clamp_(1e-30, OPAQUE)
        missing = uniform(len(gaussians), generator=generator, device=opacities.device) < rate
        slope = (1 - opacities).div_(1 - raised).masked_fill_(missing.logical_or(raised == OPAQUE), 0.0)
        logits = torch.logit(raised).masked_fill_(missing, ABSENT)
        return Dropout(replace(gaussians, logit_opacities=logits), slope)
