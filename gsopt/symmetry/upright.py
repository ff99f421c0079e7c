"""Symmetries that one to three silhouettes can prove.

So few outlines fit many planes: of those that miss by little most are false. But things stand upright, and so do
their axes and mirrors. An axis then has two numbers to find, as has a plane, which may tilt a little, because the
world may; and the true ones miss by less than a tenth of what others do (docs/decisions/0011-upright.md).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.focus import Focus, world_up
from gsopt.geometry.voxels import Grid
from gsopt.init.thumbnails import Thumbnail
from gsopt.symmetry.axis import Axis, middle_axis
from gsopt.symmetry.colors import disagreement
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import Ball, bounding_ball, candidates, half_circle, refined
from gsopt.symmetry.silhouettes import Silhouettes
from gsopt.symmetry.symmetry import Symmetry, symmetric_part

FEW_PHOTOS = 3
"""Photos up to which only upright symmetries are believed."""
TURNS = (8, 6)
"""Numbers of equal turns that are tried, in this order: as good as round, then a hexagon."""
MAX_AXIS_MISSES = 0.003
"""An axis is accepted if the outlines miss by no more than this (root mean square), in radii of the silhouettes."""
MAX_PLANE_MISSES = 0.0008
"""The same for a plane that only outlines support."""
MAX_COLORED_MISSES = 0.0032
"""The same for a plane whose colors agree."""
LEVEL_DIRECTIONS = 60
"""Normals tried, spread over the half circle: 3 degrees apart."""
CANDIDATE_ANGLE = 5.0
"""Least angle between the normals of two candidates, degrees."""
MAX_TILT = math.sin(math.radians(2))
"""Sine of the largest angle by which a plane is off the vertical, or two are off the right angle."""


def upright_symmetries(photos: list[Thumbnail], focus: Focus, grid: Grid) -> list[Symmetry]:
    """The axis of an upright object that is round or a hexagon, else its upright mirrors; `grid` is the hull."""
    ball = Ball(focus.point, focus.radius)
    silhouettes = Silhouettes(photos, ball.center, ball.radius)
    if not silhouettes.outline_something:
        return []
    up = world_up(torch.cat([photo.camera.viewmats for photo in photos]))
    pixels = sum(_silhouette_radius(photo) for photo in photos) / len(photos)
    middle = middle_axis(photos, up, focus.point)
    for turns in TURNS:
        most = MAX_AXIS_MISSES * pixels
        axis, misses = refined(Axis(up, middle, turns), silhouettes, ball, most)
        if misses <= most:
            return [_symmetry(axis, misses / pixels, photos, ball, grid)]
    return _level_mirrors(photos, silhouettes, ball, grid, up, pixels) if len(photos) > 1 else []


def _level_mirrors(
    photos: list[Thumbnail], silhouettes: Silhouettes, ball: Ball, grid: Grid, up: Float[Tensor, "3"], pixels: float
) -> list[Symmetry]:
    """The best of the level mirrors that miss by least, or by little where colors agree, and the best at right angles
    to it: two others would make the object round or a polygon, and its axis would have been found."""
    believed: list[tuple[Mirror, Symmetry]] = []
    normals = half_circle(LEVEL_DIRECTIONS, up)
    for candidate in candidates(grid, photos, bounding_ball(grid), normals, CANDIDATE_ANGLE):
        mirror, misses = refined(candidate, silhouettes, ball, MAX_PLANE_MISSES * pixels)
        if misses > MAX_COLORED_MISSES * pixels or abs(float(mirror.normal @ up)) > MAX_TILT:
            continue
        symmetry = _symmetry(mirror, misses / pixels, photos, ball, grid)
        if symmetry.colored or symmetry.misses <= MAX_PLANE_MISSES:
            believed.append((mirror, symmetry))
    believed.sort(key=lambda pair: pair[1].misses)
    across = [pair for pair in believed if abs(float(pair[0].normal @ believed[0][0].normal)) <= MAX_TILT]
    return [symmetry for _, symmetry in believed[:1] + across[:1]]


def _symmetry(element: Mirror | Axis, misses: float, photos: list[Thumbnail], ball: Ball, grid: Grid) -> Symmetry:
    shape = symmetric_part(grid, photos, element)
    return Symmetry(element, misses, disagreement(shape, photos, element, ball.radius))


def _silhouette_radius(photo: Thumbnail) -> float:
    """Half the diagonal of a silhouette's box, px."""
    solid = photo.alpha()[0] > 0.5
    sides = [torch.nonzero(solid.any(dim=axis))[:, 0] for axis in (0, 1)]
    return math.hypot(*(float(side[-1] - side[0] + 1) for side in sides)) / 2
