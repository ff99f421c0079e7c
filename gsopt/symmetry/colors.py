"""Whether an object's colours are as symmetric as its shape."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.voxels import Grid
from gsopt.init.surface_colors import seen_colors
from gsopt.init.thumbnails import Photo
from gsopt.symmetry.mirror import Mirror

NEAR = 0.1
"""Points nearer to the mirror than this are not compared, hull radii: they are their own image."""
NOISE = 0.05
"""By which equal colours differ (0..1): light, and a surface known inexactly."""
ENOUGH = 50
"""Pairs of points below which nothing is known."""


def disagreement(grid: Grid, photos: list[Photo], mirror: Mirror, radius: float) -> float:
    """Mean squared difference between the colours of mirror images on a shape's surface, where photos show both, over
    the same between two places drawn blindly: 0 where all is symmetric, 1 where nothing is, or nothing is known."""
    surface = grid.surface()
    points = surface[mirror.distance(surface) > NEAR * radius]
    colors, seen = seen_colors(grid, photos, torch.cat([points, mirror.reflect(points)]))
    here, there = colors.chunk(2)
    both = torch.logical_and(*seen.chunk(2))
    if int(both.sum()) < ENOUGH:
        return 1.0
    return float(_squared(here[both] - there[both]) / (_blind(here[both], there[both]) + 2 * NOISE**2))


def _squared(difference: Float[Tensor, "*N 3"]) -> Float[Tensor, ""]:
    return difference.square().mean()


def _blind(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Between a colour of one set and a colour of the other, whichever they are."""
    return _squared(a - a.mean(0)) + _squared(b - b.mean(0)) + _squared(a.mean(0) - b.mean(0))
