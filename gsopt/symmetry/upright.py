"""Symmetries that one to three silhouettes can prove.

So few outlines fit many planes: of those that miss by little most are false. But things stand upright, and so do
their axes and mirrors. An axis then has two numbers to find, as has a plane, which may tilt a little, because the
world may; and the true ones miss by less than others do (docs/decisions/0011-upright.md).
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
ROUND = 8
"""Turns of a round thing, whose mirrors add nothing."""
TURNS = (ROUND, 6, 4)
"""Numbers of equal turns that are tried, in this order: as good as round, then a hexagon, then a square."""
MAX_AXIS_MISSES = 0.004
"""An axis is accepted if the outlines miss by no more than this (root mean square), in radii of the silhouettes."""
MAX_PLANE_MISSES = 0.0008
"""The same for a plane that only outlines support."""
MAX_COLORED_MISSES = 0.0032
"""The same for a plane whose colors agree."""
MIRRORS_BESIDE_AXIS = 3
"""Photos from which on the mirrors of a thing with an axis are sought too: two would prove false ones."""
LEVEL_DIRECTIONS = 60
"""Normals tried, spread over the half circle: 3 degrees apart."""
CANDIDATE_ANGLE = 5.0
"""Least angle between the normals of two candidates, degrees."""
MAX_TILT_DEGREES = 2.0
"""Largest angle by which a plane is off the vertical, or two are off the angle that the object's turns ask for."""
MAX_TILT = math.sin(math.radians(MAX_TILT_DEGREES))


def upright_symmetries(photos: list[Thumbnail], focus: Focus, grid: Grid) -> list[Symmetry]:
    """The axis of an upright object that is round, a hexagon or a square, and upright mirrors; `grid` is the hull."""
    ball = Ball(focus.point, focus.radius)
    silhouettes = Silhouettes(photos, ball.center, ball.radius)
    if not silhouettes.outline_something:
        return []
    up = world_up(torch.cat([photo.camera.viewmats for photo in photos]))
    pixels = sum(_silhouette_radius(photo) for photo in photos) / len(photos)
    middle = middle_axis(photos, up, focus.point)
    most = MAX_AXIS_MISSES * pixels
    axes = (refined(Axis(up, middle, turns), silhouettes, ball, most) for turns in TURNS)
    axis, misses = next((found for found in axes if found[1] <= most), (None, 0.0))
    found = [] if axis is None else [_symmetry(axis, misses / pixels, photos, ball, grid)]
    if axis is None and len(photos) > 1:
        return _level_mirrors(photos, silhouettes, ball, grid, up, pixels, turns=2)
    if axis is not None and axis.turns < ROUND and len(photos) >= MIRRORS_BESIDE_AXIS:
        found += _level_mirrors(photos, silhouettes, ball, grid, up, pixels, axis.turns)
    return found


def _level_mirrors(
    photos: list[Thumbnail],
    silhouettes: Silhouettes,
    ball: Ball,
    grid: Grid,
    up: Float[Tensor, "3"],
    pixels: float,
    turns: int,
) -> list[Symmetry]:
    """The best of the level mirrors that miss by least, or by little where colors agree, and those at the angles to it
    that the mirrors of a thing with so many equal turns have: others would give it more turns."""
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
    kept = believed[:1]
    for mirror, symmetry in believed[1:]:
        if all(_fits(mirror, other, turns) for other, _ in kept):
            kept.append((mirror, symmetry))
    return [symmetry for _, symmetry in kept]


def _fits(mirror: Mirror, other: Mirror, turns: int) -> bool:
    """True for two planes of a thing with so many equal turns: multiples of half a turn apart, nearly."""
    angle = math.degrees(math.acos(min(1.0, abs(float(mirror.normal @ other.normal)))))
    step = 180 / turns
    return angle > step / 2 and abs(angle - step * round(angle / step)) <= MAX_TILT_DEGREES


def _symmetry(element: Mirror | Axis, misses: float, photos: list[Thumbnail], ball: Ball, grid: Grid) -> Symmetry:
    shape = symmetric_part(grid, photos, element)
    return Symmetry(element, misses, disagreement(shape, photos, element, ball.radius))


def _silhouette_radius(photo: Thumbnail) -> float:
    """Half the diagonal of a silhouette's box, px."""
    solid = photo.alpha()[0] > 0.5
    sides = [torch.nonzero(solid.any(dim=axis))[:, 0] for axis in (0, 1)]
    return math.hypot(*(float(side[-1] - side[0] + 1) for side in sides)) / 2
