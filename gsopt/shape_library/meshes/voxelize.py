"""Solid voxels of surface points: whatever light from above and from the sides does not reach."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Bool, Float, UInt8

from gsopt.shape_library.entry import COLOR_SIDE, SIDE, Shape
from gsopt.shape_library.meshes.mesh_points import SurfacePoints

FINE_SIDE = 2 * SIDE
"""Voxels along each side of the grid that is filled; eight of them become one."""
LEAST_OF_EIGHT = 3
LEAST_FREE = 2
"""Straight ways out that make a voxel air. One may be a hole between two points."""
LEAST_FLATNESS = 1 / 32
"""Shortest side of the box over the longest: a flat thing keeps some thickness."""
DIRECTIONS = [step for step in itertools.product((-1, 0, 1), repeat=3) if any(step) and step[2] >= 0]
"""To the 26 neighbors without those below: things stand on the ground, which closes them."""


def voxelized(points: SurfacePoints) -> Shape:
    """Occupancy and coarse colors in the box of the points."""
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    sizes = np.maximum(high - low, LEAST_FLATNESS * (high - low).max())
    place = ((points.xyz - (low + high) / 2) / sizes + 0.5).clip(0, 1 - 1e-9)
    surface = np.zeros((FINE_SIDE,) * 3, bool)
    surface[tuple((place * FINE_SIDE).astype(np.int64).T)] = True
    filled = surface | ~open_air(surface)
    pooled = filled.reshape(SIDE, 2, SIDE, 2, SIDE, 2).sum(axis=(1, 3, 5))
    return Shape(pooled >= LEAST_OF_EIGHT, coarse_colors(place, points.rgb), (sizes / sizes.max()).astype(np.float32))


def open_air(surface: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels with LEAST_FREE straight ways out."""
    ways = np.zeros(surface.shape, np.int8)
    for direction in DIRECTIONS:
        ways += ~blocked(surface, direction)
    return ways >= LEAST_FREE


def blocked(surface: Bool[np.ndarray, "X Y Z"], direction: tuple[int, ...]) -> Bool[np.ndarray, "X Y Z"]:
    """Voxels from which a surface lies in this direction: slice by slice, from where the direction leads."""
    axis = next(i for i, step in enumerate(direction) if step)
    found = np.zeros(surface.shape, bool)
    order = range(surface.shape[axis])[:: -direction[axis]]
    slices, walls = np.moveaxis(found, axis, 0), np.moveaxis(surface, axis, 0)
    aside = [step for i, step in enumerate(direction) if i != axis]
    for before, here in itertools.pairwise(order):
        slices[here] = shifted(slices[before] | walls[before], aside)
    return found


def shifted(plane: Bool[np.ndarray, "X Y"], steps: list[int]) -> Bool[np.ndarray, "X Y"]:
    """plane[i + step], False beyond the border."""
    for axis, step in enumerate(steps):
        if step:
            moved = np.roll(plane, -step, axis)
            edge = [slice(None), slice(None)]
            edge[axis] = slice(-1, None) if step > 0 else slice(0, 1)
            moved[tuple(edge)] = False
            plane = moved
    return plane


def coarse_colors(place: Float[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"]) -> UInt8[np.ndarray, "c c c 3"]:
    """Mean color of the points in each cell, 0 where there are none."""
    cell = (place * COLOR_SIDE).astype(np.int64) @ np.array([COLOR_SIDE**2, COLOR_SIDE, 1])
    number = np.bincount(cell, minlength=COLOR_SIDE**3).clip(1)
    sums = [np.bincount(cell, rgb[:, i].astype(np.float64), minlength=COLOR_SIDE**3) for i in range(3)]
    means = np.stack(sums, axis=1) / number[:, None]
    return means.round().astype(np.uint8).reshape(COLOR_SIDE, COLOR_SIDE, COLOR_SIDE, 3)
