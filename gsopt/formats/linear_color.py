"""Colors of splats between linear light and the sRGB coding of images (IEC 61966-2-1)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import sh

_KNEE = 0.0031308
_SLOPE = 12.92
_GAMMA = 2.4


def linear_from_srgb(coded: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Linear light of coded values 0..1."""
    return torch.where(coded <= _KNEE * _SLOPE, coded / _SLOPE, ((coded + 0.055) / 1.055).clamp_min(0).pow(_GAMMA))


def srgb_from_linear(linear: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Inverse of `linear_from_srgb`."""
    return torch.where(linear <= _KNEE, linear * _SLOPE, 1.055 * linear.clamp_min(_KNEE).pow(1 / _GAMMA) - 0.055)


def srgb_from_linear_color(gaussians: Gaussians) -> Gaussians:
    """Splats whose harmonics give linear light, as splats whose harmonics give coded color.

    Exact for the base color; the bands above are scaled by the slope of the coding there, its first order.
    """
    base = sh.rgb_from_sh0(gaussians.sh0).clamp_min(0)
    bent = 1.055 / _GAMMA * base.clamp_min(_KNEE).pow(1 / _GAMMA - 1)
    slope = torch.where(base <= _KNEE, torch.full_like(base, _SLOPE), bent)
    return replace(gaussians, sh0=sh.sh0_from_rgb(srgb_from_linear(base)), shN=gaussians.shN * slope)
