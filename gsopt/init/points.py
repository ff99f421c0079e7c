"""Gaussians at given points: round, faint, as large as the gap to their neighbors (Kerbl et al. 2023, section 5.1)."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.sh import sh0_from_rgb
from gsopt.init.neighbors import mean_neighbor_distance

FIRST_OPACITY = 0.1
NEIGHBORS = 3


def gaussians_at(xyz: Float[Tensor, "N 3"], rgb: Float[Tensor, "N 3"], sh_degree: int) -> Gaussians:
    """Isotropic Gaussians at `xyz` (float32) of color `rgb` (0..1).

    Standard deviation: the mean distance to the three nearest others; opacity 0.1; no rotation; bands above 0 are 0.
    """
    count = len(xyz)
    log_distance = mean_neighbor_distance(xyz, NEIGHBORS).log()
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=xyz.clone(),
        quats=quats,
        log_scales=log_distance[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), math.log(FIRST_OPACITY / (1 - FIRST_OPACITY))),
        sh0=sh0_from_rgb(rgb)[:, None],
        shN=torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )
