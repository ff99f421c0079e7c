"""Finds Gaussians that hang in space: those far from their neighbors (GaussianObject, Yang et al. 2024), and haze.

Thin parts lie as far from others, but nothing else covers their pixels: what would open a hole in a silhouette stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import Backend
from gsopt.training.density.contribution import openings

# Neighbors are looked for among at most this many Gaussians: the estimate of the local density stays, the cost does
# not grow with the square of N. The rows are in Morton order, so that an even stride is an even sample of space.
MAX_REFERENCES = 1024
MIN_GAUSSIANS = 64
"""Below this many Gaussians the statistics mean nothing and none is called a floater."""
MIN_RELATIVE_STD = 0.01
"""Smallest standard deviation, as a share of the mean: where all are alike, rounding alone makes no floater."""
CHUNK = 1024
FAINT = 0.1
"""Opacity below which a Gaussian right before a camera is haze."""
MAX_OPENING = 0.05
"""Largest mean fall of alpha, over what a Gaussian covers in silhouettes, for it to be a floater."""


def floaters(
    gaussians: Gaussians, sigmas: float, silhouettes: Sequence[Cameras], backend: Backend, *, antialiased: bool
) -> Bool[Tensor, "N"]:
    """True where a Gaussian is solitary and no silhouette needs it.

    `silhouettes`: cameras of the input views, of an object; none of a scene, whose edge is open wherever photos end.
    """
    alone = solitary(gaussians.means, sigmas)
    if not bool(alone.any()):
        return alone
    return alone & (openings(gaussians, alone, silhouettes, backend, antialiased=antialiased) <= MAX_OPENING)


def haze(gaussians: Gaussians, cameras: Sequence[Cameras], distance: float) -> Bool[Tensor, "N"]:
    """True where a Gaussian is faint and nearer than `distance` to one of the cameras: it corrects the colors of that
    one image, and hangs before whoever looks from beside it."""
    found = gaussians.opacities < FAINT
    means, near = gaussians.means[found], torch.zeros(int(found.sum()), dtype=torch.bool, device=found.device)
    for camera in cameras:
        near |= (means - camera.centers[0].to(means)).square().sum(1) < distance**2
    found[found.clone()] = near
    return found


def solitary(means: Float[Tensor, "N 3"], sigmas: float) -> Bool[Tensor, "N"]:
    """True where the mean distance to the nearest neighbors exceeds its average by `sigmas` standard deviations."""
    if len(means) < MIN_GAUSSIANS:
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)
    distances = neighbor_distances(means)
    mean = distances.mean()
    return distances > mean + sigmas * torch.maximum(distances.std(), MIN_RELATIVE_STD * mean)


def neighbor_distances(means: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Mean distance, scene units, to the nearest √N neighbors, or to the same share of at most 1024 references."""
    count = len(means)
    stride = -(-count // MAX_REFERENCES)
    references = means[::stride]
    nearest = max(3, round(math.sqrt(count) / stride))
    chunks = []
    for begin in range(0, count, CHUNK):
        rows = torch.arange(begin, min(begin + CHUNK, count), device=means.device)
        distances = torch.cdist(means[rows], references, compute_mode="donot_use_mm_for_euclid_dist")
        own = rows % stride == 0
        distances[own.nonzero()[:, 0], rows[own] // stride] = math.inf
        chunks.append(distances.topk(nearest, largest=False).values.mean(dim=1))
    return torch.cat(chunks)
