"""Measures what each Gaussian adds to the input views, and finds those that add least, to make room for growth.

A budget that is full leaves density control nothing to grow with, although many Gaussians add next to nothing: they lie
behind others, or cover less than a pixel (importance by the sum of blending weights: Fan et al. 2023, "LightGaussian").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.sh import C0
from gsopt.raster.backend import Backend, RasterSettings

MAX_VIEWS = 25
"""Input views that are looked at, evenly spread."""


def contributions(
    gaussians: Gaussians, cameras: Sequence[Cameras], backend: Backend, *, antialiased: bool
) -> Float[Tensor, "N"]:
    """The sum of T alpha over the pixels of up to MAX_VIEWS cameras, px: dLoss/dcolor of a loss that adds up the pixels
    of one channel."""
    count = min(MAX_VIEWS, len(cameras))
    settings = RasterSettings(sh_degree=0, antialiased=antialiased)
    gray = replace(gaussians, sh0=torch.zeros_like(gaussians.sh0))  # a black one, clamped, would have no gradient
    total = torch.zeros_like(gaussians.logit_opacities)
    for camera in (cameras[i * len(cameras) // count] for i in range(count)):
        frame = backend.forward(gray, camera, settings)
        gradients = backend.backward(frame, torch.ones_like(frame.colors), bands=False)
        total += gradients.sh0[:, 0, 0] / C0
    return total


def least(values: Float[Tensor, "N"], share: float) -> Bool[Tensor, "N"]:
    """True for the lowest `share` of the values, never for all; equal ones in row order."""
    found = torch.zeros_like(values, dtype=torch.bool)
    found[torch.argsort(values, stable=True)[: min(int(share * len(values)), len(values) - 1)]] = True
    return found
