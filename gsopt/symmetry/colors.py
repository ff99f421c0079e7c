"""A test of the symmetry of an object's colors."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.voxels import Grid
from gsopt.init.surface_colors import seen_colors
from gsopt.init.thumbnails import Thumbnail
from gsopt.symmetry.axis import Axis
from gsopt.symmetry.mirror import Mirror

MIN_DISTANCE = 0.1
"""Points nearer to the mirror than this are not compared, hull radii: they are their own image."""
COLOR_NOISE = 0.05
"""Difference of equal colors (0..1): light, and a surface known inexactly."""
MIN_PAIRS = 50
"""Pairs of points below which nothing is known."""


def disagreement(grid: Grid, photos: list[Thumbnail], mirror: Mirror | Axis, radius: float) -> float:
    """Mean squared difference between the colors of mirror images on a shape's surface, where photos show both, over
    the same between two random points: 0 when all is symmetric, 1 when nothing is, or nothing is known."""
    surface = grid.surface()
    points = surface[mirror.distance(surface) > MIN_DISTANCE * radius]
    colors, seen = seen_colors(grid, photos, torch.cat([points, next(iter(mirror.images(points)))]))
    here, there = colors.chunk(2)
    both = torch.logical_and(*seen.chunk(2))
    if int(both.sum()) < MIN_PAIRS:
        return 1.0
    return float(_squared(here[both] - there[both]) / (_blind(here[both], there[both]) + 2 * COLOR_NOISE**2))


def _squared(difference: Float[Tensor, "*N 3"]) -> Float[Tensor, ""]:
    return difference.square().mean()


def _blind(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean squared difference between any color of one set and any color of the other."""
    return _squared(a - a.mean(0)) + _squared(b - b.mean(0)) + _squared(a.mean(0) - b.mean(0))
