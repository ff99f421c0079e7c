"""Marks what no photo shows: with few photos, the part of a reconstruction that is a guess."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import make_backend
from gsopt.sds.coverage import coverage

MIN_COVERAGE = 0.5
"""Coverage (gsopt/sds/coverage.py) below which a Gaussian counts as unseen: hidden in, outside of or edge-on to every
input view."""
MARK = torch.tensor([1.0, 0.1, 0.8])
MARK_SHARE = 0.7
"""Share of the mark in the color of a marked splat."""


@torch.no_grad()
def unseen(gaussians: Gaussians, cameras: Sequence[Cameras]) -> Bool[Tensor, "N"]:
    """True for every Gaussian that no input camera sees."""
    backend = make_backend("auto", 1)
    return coverage(gaussians.to(backend.device), cameras, backend) < MIN_COVERAGE


def marked(rgb: Float[Tensor, "N 3"], hidden: Bool[Tensor, "N"]) -> Float[Tensor, "N 3"]:
    """The colors, those of hidden splats mixed with the mark."""
    return torch.where(hidden[:, None], (1 - MARK_SHARE) * rgb + MARK_SHARE * MARK, rgb)
