"""Measures what each Gaussian adds to the input views: what adds least makes room, what carries a silhouette stays.

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
    settings, gray = RasterSettings(sh_degree=0, antialiased=antialiased), _gray(gaussians)
    total = torch.zeros_like(gaussians.logit_opacities)
    for camera in _spread(cameras):
        frame = backend.forward(gray, camera, settings)
        gradients = backend.backward(frame, torch.ones_like(frame.colors), bands=False)
        total += gradients.sh0[:, 0, 0] / C0
    return total


def openings(
    gaussians: Gaussians, removed: Bool[Tensor, "N"], cameras: Sequence[Cameras], backend: Backend, *, antialiased: bool
) -> Float[Tensor, "N"]:
    """The mean fall of alpha without `removed` over the pixels of each Gaussian, weighted by T alpha; 0 where it is
    not seen."""
    settings, gray = RasterSettings(sh_degree=0, antialiased=antialiased), _gray(gaussians)
    others = gray.select(~removed)
    added, opened = (torch.zeros_like(gaussians.logit_opacities) for _ in range(2))
    for camera in _spread(cameras):
        without = backend.forward(others, camera, settings).alphas
        frame = backend.forward(gray, camera, settings)
        fall = (frame.alphas - without).clamp_min(0)
        gradients = backend.backward(frame, torch.stack([torch.ones_like(fall), fall, fall], -1), bands=False)
        added += gradients.sh0[:, 0, 0]
        opened += gradients.sh0[:, 0, 1]
    return opened / added.clamp_min(torch.finfo(added.dtype).tiny)


def _gray(gaussians: Gaussians) -> Gaussians:
    """With one color, which is not black: that, clamped, would have no gradient."""
    return replace(gaussians, sh0=torch.zeros_like(gaussians.sh0))


def _spread(cameras: Sequence[Cameras]) -> list[Cameras]:
    count = min(MAX_VIEWS, len(cameras))
    return [cameras[i * len(cameras) // count] for i in range(count)]


def least(values: Float[Tensor, "N"], share: float) -> Bool[Tensor, "N"]:
    """True for the lowest `share` of the values, never for all; equal ones in row order."""
    found = torch.zeros_like(values, dtype=torch.bool)
    found[torch.argsort(values, stable=True)[: min(int(share * len(values)), len(values) - 1)]] = True
    return found
