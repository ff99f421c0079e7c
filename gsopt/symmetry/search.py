"""Search for mirror planes: all directions on coarse voxels, then refinement of the best on the outlines."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid, dilated
from gsopt.init.thumbnails import Thumbnail
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.cpu_backend import workspace
from gsopt.raster.threads import preparing_threads
from gsopt.symmetry.axis import Axis, perpendicular
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.silhouettes import RayPoints, Silhouettes

DIRECTIONS = 400
"""Normals tried, spread over the half sphere: about 7 degrees apart."""
OFFSETS, MAX_OFFSET = 13, 0.2
"""Planes tried per normal, and their largest distance from the hull's center, in hull radii."""
COARSENING = 3
"""Voxels joined along each axis."""
MAX_UNCOVERED = 0.05
"""A candidate may leave this share of the silhouettes unexplained: its direction is 3 degrees off."""
COARSEST, HOPELESS = 6, 0.1
"""Voxels joined along each axis for a first look, and the share that a plane leaves unexplained there, give or take a
voxel twice as large, when it is not looked at again."""
CANDIDATE_ANGLE = 20.0
"""Least angle between the normals of two candidates, degrees."""
MAX_CANDIDATES = 6
"""Candidates refined."""
MAX_STEPS, MAX_DAMPINGS = 15, 4
"""Steps of the refinement, and dampings tried for each."""
LEAST_GAIN, LEAST_STEP = 0.995, 3e-4
"""It ends when a step leaves more than this share of the misses, or moves by less: radians, radii."""
GIVE_UP_AT, GIVE_UP_ABOVE = 4, 3.0
"""It is abandoned when this many steps leave more than so many times the accepted misses."""
M = TypeVar("M", Mirror, Axis)


@dataclass(frozen=True)
class Ball:
    """A ball around the hull."""

    center: Float[Tensor, "3"]
    radius: float


def bounding_ball(grid: Grid) -> Ball:
    cells = grid.centers()
    center = cells.mean(0)
    return Ball(center, float((cells - center).norm(dim=1).max()) + grid.voxel)


def candidates(
    grid: Grid, photos: list[Thumbnail], ball: Ball, normals: Float[Tensor, "D 3"], apart: float
) -> list[Mirror]:
    """Up to MAX_CANDIDATES planes with these normals, best first: those that leave least of the silhouettes unexplained
    when the hull is cut with its mirror image."""
    shifts = torch.linspace(-MAX_OFFSET, MAX_OFFSET, OFFSETS) * ball.radius
    middle = (normals * ball.center).sum(1)
    offsets = (middle[:, None] + shifts).flatten()
    normals = normals.repeat_interleave(OFFSETS, 0)
    rows = torch.nonzero(uncovered(joined(grid, COARSEST), photos, normals, offsets) <= HOPELESS)[:, 0]
    if len(rows) == 0:
        return []
    normals, offsets = normals[rows], offsets[rows]
    lost = uncovered(joined(grid, COARSENING), photos, normals, offsets)
    found: list[Mirror] = []
    for row in lost.argsort(stable=True).tolist():
        if len(found) == MAX_CANDIDATES or float(lost[row]) > MAX_UNCOVERED:
            break
        mirror = Mirror(normals[row], float(offsets[row]))
        if not any(same(mirror, other, apart) for other in found):
            found.append(mirror)
    return found


def same(a: Mirror, b: Mirror, degrees: float) -> bool:
    """True when the normals of two planes are nearer to each other than `degrees`."""
    return abs(float((a.normal * b.normal).sum())) > math.cos(math.radians(degrees))


def half_sphere(count: int) -> Float[Tensor, "N 3"]:
    """Evenly spread directions with z > 0, along a spiral of golden angles."""
    row = torch.arange(count) + 0.5
    z, turn = row / count, row * math.pi * (3 - math.sqrt(5))
    ring = (1 - z**2).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)


def half_circle(count: int, up: Float[Tensor, "3"]) -> Float[Tensor, "N 3"]:
    """Evenly spread directions across `up`."""
    u = perpendicular(up)
    angles = math.pi * torch.arange(count) / count
    return angles.cos()[:, None] * u + angles.sin()[:, None] * torch.linalg.cross(up, u)


def joined(grid: Grid, factor: int) -> Grid:
    """Coarser voxels, true where any of theirs is."""
    cells = torch.nn.functional.max_pool3d(grid.occupied[None, None].float(), factor, factor, ceil_mode=True)[0, 0] > 0
    return Grid(cells, grid.low, grid.voxel * factor)


def uncovered(
    grid: Grid, photos: list[Thumbnail], normals: Float[Tensor, "P 3"], offsets: Float[Tensor, "P"]
) -> Float[Tensor, "P"]:
    """For every plane the share of the silhouettes (in pixels a voxel wide, mean over the photos) that no voxel covers
    whose mirror image also lies in the hull, give or take one voxel."""
    cells = torch.nonzero(grid.occupied).float() + 0.5
    offsets = (offsets - (normals * grid.low).sum(1)) / grid.voxel
    centers = grid.centers()
    pixels = [_pixels(photo, centers, grid.voxel) for photo in photos]
    lost = torch.empty(len(normals))
    wide = dilated(grid.occupied).view(torch.uint8)
    _cpu.mirror(workspace(preparing_threads()), cells, normals.contiguous(), offsets, wide, pixels, lost)
    return lost


def _pixels(
    photo: Thumbnail, centers: Float[Tensor, "M 3"], voxel: float
) -> tuple[Int32[Tensor, "K"], Int32[Tensor, "K"], int]:
    """Rows of the centers that the photo shows, the pixel of each, counted from 0 without gaps, and their number."""
    column, row, depth = project(photo.camera, centers)
    shown = torch.nonzero(inside(photo.camera, column, row, depth))[:, 0]
    if len(shown) == 0:
        return shown.int(), shown.int(), 0
    step = max(1.0, voxel * float(photo.camera.Ks[0, 0, 0]) / float(depth[shown].median()))
    width = math.ceil(photo.camera.width / step) + 1
    pixel = (row[shown] / step).long() * width + (column[shown] / step).long()
    occupied, place = torch.unique(pixel, return_inverse=True)
    return shown.int(), place.int(), len(occupied)


def refined(mirror: M, silhouettes: Silhouettes, ball: Ball, wanted: float) -> tuple[M, float]:
    """The plane or axis moved to where the outlines miss least (Levenberg-Marquardt over what `moved` takes), and the
    root mean square of what is left, px. One that stays far from `wanted` is given up."""
    near, damping = silhouettes.near_optima(mirror), 1e-2
    misses = silhouettes.misses(mirror, near)
    for iteration in range(MAX_STEPS):
        if iteration == GIVE_UP_AT and _rms(misses) > GIVE_UP_ABOVE * wanted:
            break
        J = _jacobian(mirror, silhouettes, near, ball)
        A, b = J.T @ J, J.T @ misses
        step = None
        for _ in range(MAX_DAMPINGS):
            tried = -torch.linalg.solve(A + damping * torch.diag(A.diagonal() + 1e-6), b)
            moved = mirror.moved(tried, ball.center, ball.radius)
            ahead = silhouettes.near_optima(moved)
            left = silhouettes.misses(moved, ahead)
            if _rms(left) < LEAST_GAIN * _rms(misses):
                step, mirror, near, misses, damping = tried, moved, ahead, left, max(damping / 4, 1e-6)
                break
            damping *= 4
        if step is None or float(step.abs().max()) < LEAST_STEP:
            break
    return mirror, _rms(misses)


def _rms(misses: Float[Tensor, "P"]) -> float:
    return float(misses.square().mean().sqrt())


def _jacobian(
    mirror: M, silhouettes: Silhouettes, near: RayPoints, ball: Ball, step: float = 2e-3
) -> Float[Tensor, "P D"]:
    """d(misses)/d(change) by central differences among the points near the optima."""
    columns = []
    for change in step * torch.eye(mirror.freedom):
        moved = (mirror.moved(way * change, ball.center, ball.radius) for way in (1, -1))
        ahead, behind = (silhouettes.misses(each, near) for each in moved)
        columns.append((ahead - behind) / (2 * step))
    return torch.stack(columns, 1)
