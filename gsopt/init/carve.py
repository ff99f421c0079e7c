"""The photo hull of few views: take from the visual hull what the photos contradict (Kutulakos and Seitz 2000).

Silhouettes leave concave regions filled. A voxel there shows each view whatever stands behind it, in different colours.
Pass by pass, the voxels seen by at least two views are judged by colour and those that disagree are taken off, which
uncovers the next ones. Voxels that one view sees, and the last ones that cover a place of a silhouette, stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.init.photos import Photo
from gsopt.init.rig import inside, project

MOST_VIEWS = 32
"""Input views above which the silhouettes alone do."""
TOLERANCE = 0.12
"""Gap between the colour ranges of two views, sRGB 0..1, from which on they disagree."""
PASSES = 40
_PATCH = 1.5
"""Side of the patch a voxel's colour range is taken from, in projected voxels."""
_ENOUGH = 2e-4
"""Share of the hull's voxels: a pass that removes fewer is the last."""
_SOLID = 0.5


@dataclass(frozen=True)
class _Sight:
    """Every voxel in one view."""

    block: Int[Tensor, "M"]
    """Index of the place (a block of pixels about a voxel and a half large) it covers; the last one: out of view."""
    blocks: int
    depth: Float[Tensor, "M"]
    pixel: Int[Tensor, "M"]
    low: Float[Tensor, "P 3"]
    """Lowest colour in the patch around each pixel, sRGB 0..1."""
    high: Float[Tensor, "P 3"]


def photo_hull(
    occupied: Bool[Tensor, "X Y Z"], low: Float[Tensor, "3"], voxel: float, photos: list[Photo]
) -> Bool[Tensor, "X Y Z"]:
    """The voxels of a visual hull (its corner `low` and edge `voxel` in scene units) that the photos do not contradict.

    Every place in a photo that the hull covers stays covered.
    """
    cells = torch.nonzero(occupied)
    centers = low + (cells + 0.5) * voxel
    sights = [_sight(photo, centers, voxel) for photo in photos]
    cover = [torch.bincount(sight.block, minlength=sight.blocks + 1) for sight in sights]
    number = torch.full(occupied.shape, -1)
    number[occupied] = torch.arange(len(cells))
    left, locked = occupied.clone(), torch.zeros(len(cells), dtype=torch.bool)
    for _ in range(PASSES):
        surface = number[left & ~_buried(left)]
        gap, seen = disagreement(sights, surface, voxel)
        gap = _smoothed(left.shape, cells[surface], gap, seen)
        doubtful = surface[(seen >= 2) & (gap > TOLERANCE) & ~locked[surface]]
        gone = _uncovering_nothing(sights, cover, doubtful, locked)
        left[tuple(cells[gone].T)] = False
        if len(gone) <= _ENOUGH * len(cells):
            break
    return left


def _sight(photo: Photo, centers: Float[Tensor, "M 3"], voxel: float) -> _Sight:
    column, row, depth = project(photo.camera, centers)
    shown = inside(photo.camera, column, row, depth)
    column, row = (torch.where(shown, coordinate, 0.0) for coordinate in (column, row))
    width, height = photo.camera.width, photo.camera.height
    scale = float(photo.camera.Ks[0, 0, 0])
    footprint = voxel * scale / float(depth[shown].median()) if bool(shown.any()) else 1.0
    step = max(1, math.ceil(1.5 * footprint))
    across, down = math.ceil(width / step), math.ceil(height / step)
    block = (row / step).long().clamp(0, down - 1) * across + (column / step).long().clamp(0, across - 1)
    pixel = row.long().clamp(0, height - 1) * width + column.long().clamp(0, width - 1)
    low, high = _color_ranges(photo, max(1, round(_PATCH * footprint)))
    return _Sight(torch.where(shown, block, across * down), across * down, depth, pixel, low, high)


def _color_ranges(photo: Photo, patch: int) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Lowest and highest colour of the solid pixels within a patch; 0 and 1, which agree with all, where none is."""
    patch += 1 - patch % 2
    planes = photo.planes.float() / 255
    solid = planes[3] > _SOLID
    color = planes[:3] / planes[3:].clamp(min=_SOLID)
    ends = []
    for sign in (-1.0, 1.0):
        signed = torch.where(solid, sign * color, -1.0)
        ends.append(sign * torch.nn.functional.max_pool2d(signed[None], patch, 1, patch // 2)[0])
    none = torch.nn.functional.max_pool2d(solid[None].float(), patch, 1, patch // 2)[0] == 0
    low, high = torch.where(none, 0.0, ends[0]), torch.where(none, 1.0, ends[1])
    return low.flatten(1).T.contiguous(), high.flatten(1).T.contiguous()


def disagreement(
    sights: list[_Sight], surface: Int[Tensor, "S"], voxel: float
) -> tuple[Float[Tensor, "S"], Int[Tensor, "S"]]:
    """How far apart the colours of the views that see a surface voxel are, and how many views see it.

    The gap between the highest low end and the lowest high end of their colour ranges, of the worst channel; not
    positive where all ranges meet. With four views or more the one farthest out does not count: a highlight.
    """
    lows = torch.full((len(sights), len(surface), 3), -math.inf)
    highs = torch.full((len(sights), len(surface), 3), math.inf)
    seen = torch.zeros(len(surface), dtype=torch.long)
    for index, sight in enumerate(sights):
        block, depth = sight.block[surface], sight.depth[surface]
        front = torch.full((sight.blocks + 1,), math.inf).scatter_reduce(0, block, depth, "amin")
        visible = (depth <= front[block] + voxel) & (block < sight.blocks)
        seen += visible
        pixel = sight.pixel[surface]
        lows[index] = torch.where(visible[:, None], sight.low[pixel], -math.inf)
        highs[index] = torch.where(visible[:, None], sight.high[pixel], math.inf)
    gap = (lows.amax(0) - highs.amin(0)).amax(1)
    if len(sights) >= 4:
        second_low, second_high = lows.topk(2, dim=0).values[1], -(-highs).topk(2, dim=0).values[1]
        trimmed = torch.maximum(second_low - highs.amin(0), torch.zeros(1))
        trimmed = torch.minimum(trimmed.amax(1), (lows.amax(0) - second_high).amax(1))
        gap = torch.where(seen >= 4, trimmed, gap)
    return torch.where(seen >= 2, gap, 0.0), seen


def _smoothed(
    shape: torch.Size, cells: Int[Tensor, "S 3"], gap: Float[Tensor, "S"], seen: Int[Tensor, "S"]
) -> Float[Tensor, "S"]:
    """Mean gap over the judged surface voxels among a voxel and its 26 neighbours: one voxel alone is no evidence."""
    planes = torch.zeros(2, *shape)
    at = tuple(cells.T)
    judged = (seen >= 2).float()
    planes[(0, *at)] = gap.clamp(0, 0.5) * judged
    planes[(1, *at)] = judged
    total, count = torch.nn.functional.avg_pool3d(planes[:, None], 3, stride=1, padding=1)[:, 0]
    return (total / count.clamp(min=1e-6))[at]


def _uncovering_nothing(
    sights: list[_Sight], cover: list[Int[Tensor, "B"]], doubtful: Int[Tensor, "D"], locked: Bool[Tensor, "M"]
) -> Int[Tensor, "G"]:
    """Those of the doubtful voxels that can go while every place stays covered; the others are locked."""
    kept = torch.zeros(len(doubtful), dtype=torch.bool)
    for sight, count in zip(sights, cover, strict=True):
        block = sight.block[doubtful]
        count -= torch.bincount(block, minlength=len(count))
        kept |= (count[block] <= 0) & (block < sight.blocks)
    for sight, count in zip(sights, cover, strict=True):
        count += torch.bincount(sight.block[doubtful[kept]], minlength=len(count))
    locked[doubtful[kept]] = True
    return doubtful[~kept]


def _buried(cells: Bool[Tensor, "X Y Z"]) -> Bool[Tensor, "X Y Z"]:
    """True voxels whose six neighbours are true."""
    padded = torch.nn.functional.pad(cells, (1,) * 6)
    inner = slice(1, -1)
    buried = cells.clone()
    for side in (slice(None, -2), slice(2, None)):
        buried &= padded[side, inner, inner] & padded[inner, side, inner] & padded[inner, inner, side]
    return buried
