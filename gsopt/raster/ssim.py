"""L1 and structural similarity (Wang et al. 2004) as Gaussian splatting trains with them: their one home in torch.

SSIM has an 11x11 Gaussian window of sigma 1.5 px, zero padding, biased (window-weighted) variances, a dynamic range
of 1, and is taken per channel. The gradient that the compiled kernels write out is derived in docs/math.md, eqs. 19-21.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def window(like: Tensor) -> Float[Tensor, "11"]:
    """One-dimensional Gaussian weights that sum to 1, in the dtype and on the device of `like`."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    return (weights / weights.sum()).to(like)


def blur(images: Float[Tensor, "*B H W 3"]) -> Float[Tensor, "*B H W 3"]:
    """Each channel convolved with the separable window; outside the image there are zeros."""
    height, width, channels = images.shape[-3:]
    planes = images.movedim(-1, -3).reshape(-1, 1, height, width)
    weights = window(images)
    planes = functional.conv2d(planes, weights.view(1, 1, 1, -1), padding=(0, WINDOW // 2))
    planes = functional.conv2d(planes, weights.view(1, 1, -1, 1), padding=(WINDOW // 2, 0))
    return planes.reshape(*images.shape[:-3], channels, height, width).movedim(-3, -1)


def ssim_map(rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"]) -> Float[Tensor, "*B H W 3"]:
    """SSIM at every pixel and channel, 1 where the two agree around it."""
    mu_x, mu_y = blur(rendered), blur(target)
    var_x = blur(rendered * rendered) - mu_x * mu_x
    var_y = blur(target * target) - mu_y * mu_y
    cov = blur(rendered * target) - mu_x * mu_y
    luminance = (2 * mu_x * mu_y + C1) / (mu_x * mu_x + mu_y * mu_y + C1)
    contrast_structure = (2 * cov + C2) / (var_x + var_y + C2)
    return luminance * contrast_structure


def ssim(rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"]) -> Float[Tensor, ""]:
    """Mean of `ssim_map` over batch, pixels and channels."""
    return ssim_map(rendered, target).mean()


def l1(rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"]) -> Float[Tensor, ""]:
    """Mean absolute difference over batch, pixels and channels."""
    return (rendered - target).abs().mean()


def photometric_terms(
    rendered: Float[Tensor, "*B H W 3"], target: Float[Tensor, "*B H W 3"], lambda_dssim: float
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
    """L1, SSIM and (1 - lambda) L1 + lambda (1 - SSIM), the loss of Kerbl et al. 2023, eq. 7."""
    difference, similarity = l1(rendered, target), ssim(rendered, target)
    return difference, similarity, (1 - lambda_dssim) * difference + lambda_dssim * (1 - similarity)
