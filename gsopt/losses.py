"""What a step minimises: pure functions of torch tensors, each a scalar. L1 and SSIM live in gsopt/raster/ssim.py."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.raster.ssim import l1, photometric_terms, ssim

__all__ = ["alpha_l1", "depth_l1", "dssim", "l1", "opacity", "photometric", "scale", "ssim"]


def dssim(rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"]) -> Float[Tensor, ""]:
    """1 - SSIM (without the ½ that some texts put in front)."""
    return 1 - ssim(rendered, target)


def photometric(
    rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"], lambda_dssim: float
) -> Float[Tensor, ""]:
    """(1 - lambda) L1 + lambda (1 - SSIM); what `Backend.photometric` fuses with its gradient."""
    return photometric_terms(rendered, target, lambda_dssim)[2]


def alpha_l1(alphas: Float[Tensor, "*B H W 1"], target: Float[Tensor, "*B H W 1"]) -> Float[Tensor, ""]:
    """Mean absolute difference between the rendered alpha and the image's alpha or mask."""
    return (alphas - target).abs().mean()


def depth_l1(
    depths: Float[Tensor, "*B H W 1"], target: Float[Tensor, "*B H W 1"], known: Bool[Tensor, "*B H W 1"]
) -> Float[Tensor, ""]:
    """Mean absolute difference in scene units where the target is known; 0 where nothing is known."""
    difference = torch.where(known, depths - target, torch.zeros_like(depths)).abs()
    return difference.sum() / known.sum().clamp_min(1)


def opacity(logit_opacities: Float[Tensor, " N"]) -> Float[Tensor, ""]:
    """Mean opacity (Kheradmand et al. 2024, eq. 8); 0 for no Gaussians."""
    return torch.sigmoid(logit_opacities).sum() / max(1, logit_opacities.numel())


def scale(log_scales: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean standard deviation over Gaussians and axes, scene units (Kheradmand et al. 2024, eq. 8); 0 for none."""
    return log_scales.exp().sum() / max(1, log_scales.numel())
