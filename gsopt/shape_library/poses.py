"""Turns of every shape of a library whose silhouettes look like that of the photo.

A shape is turned about the vertical, mirrored or not, and its silhouette stretched to the photo's box:

    (1)  s = IoU(silhouettes in their boxes) - ASPECT_WEIGHT |log(ratio of their aspects)|.

Stretching stands for the anisotropic scale that an alignment may choose; the second term makes it dear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.geometry.voxels import eroded
from gsopt.shape_library.outline import Outline

TURNS = 24
"""Turns about the vertical, evenly spaced."""
RASTER = 32
"""Pixels along each side of the compared silhouettes."""
POINTS = 700
"""Surface points of each shape."""
ASPECT_WEIGHT = 0.25
CHUNK = 512
"""Shapes that are projected at once."""


@dataclass(frozen=True)
class Poses:
    """Shapes in poses, one a row."""

    row: Int[Tensor, "B"]
    """Index of the shape."""
    azimuth: Float[Tensor, "B"]
    mirror: Float[Tensor, "B"]
    """-1 for a mirrored shape, else 1."""
    likeness: Float[Tensor, "B"]
    """s of (1)."""

    def __getitem__(self, rows: Tensor) -> Poses:
        return Poses(self.row[rows], self.azimuth[rows], self.mirror[rows], self.likeness[rows])


def surface_points(occupied: Bool[Tensor, "s s s"], sizes: Float[Tensor, "3"]) -> Float[Tensor, "P 3"]:
    """POINTS centers of surface voxels, spread over the shape, in its box around 0."""
    cells = torch.nonzero(occupied & ~eroded(occupied))
    rows = torch.linspace(0, len(cells) - 1, POINTS).long()
    return ((cells[rows] + 0.5) / occupied.shape[0] - 0.5) * sizes


@torch.no_grad()
def best_poses(outline: Outline, points: Float[Tensor, "N P 3"], each: int) -> Poses:
    """The `each` best poses of every shape by (1), shape by shape."""
    target = outline.cropped(RASTER) > 0.5
    aspect = math.log(float(outline.sides[0] / outline.sides[1]))
    found = []
    for chunk in points.split(CHUNK):
        scores = torch.empty(len(chunk), TURNS, 2)
        for turn in range(TURNS):
            drawn, ratio = _silhouettes(outline, chunk, 2 * math.pi * turn / TURNS)
            dear = ASPECT_WEIGHT * (ratio.log() - aspect).abs()
            scores[:, turn, 0] = overlap(drawn, target) - dear
            scores[:, turn, 1] = overlap(drawn.flip(2), target) - dear
        found.append(scores.flatten(1).topk(each, dim=1))
    likeness, place = torch.cat([one.values for one in found]), torch.cat([one.indices for one in found])
    azimuth = 2 * math.pi / TURNS * (place // 2).float()
    flipped = place % 2 == 1  # seen in a mirror, a shape turns the other way
    azimuth = torch.where(flipped, -azimuth, azimuth)
    row = torch.arange(len(points))[:, None].expand_as(place)
    return Poses(row.flatten(), azimuth.flatten(), (1 - 2 * flipped.float()).flatten(), likeness.flatten())


def overlap(drawn: Bool[Tensor, "N S S"], target: Bool[Tensor, "S S"]) -> Float[Tensor, "N"]:
    """Intersection over union with the target."""
    return (drawn & target).sum((1, 2)) / (drawn | target).sum((1, 2)).clamp_min(1)


def _silhouettes(
    outline: Outline, points: Float[Tensor, "N P 3"], azimuth: float
) -> tuple[Bool[Tensor, "N S S"], Float[Tensor, "N"]]:
    """Silhouettes in their boxes, and width over height of these boxes."""
    turned = points @ turn_matrix(torch.tensor(azimuth)).T
    pixels = outline.project(outline.middle + outline.size * turned @ outline.upright.T)
    low, high = pixels.amin(dim=1, keepdim=True), pixels.amax(dim=1, keepdim=True)
    sides = (high - low).clamp_min(1e-6)
    cell = ((pixels - low) / sides * RASTER).long().clamp(0, RASTER - 1)
    drawn = torch.zeros(len(points), RASTER * RASTER)
    drawn.scatter_(1, cell[..., 1] * RASTER + cell[..., 0], 1.0)
    return closed(drawn.view(-1, RASTER, RASTER)) > 0.5, sides[:, 0, 0] / sides[:, 0, 1]


def closed(drawn: Float[Tensor, "N S S"]) -> Float[Tensor, "N S S"]:
    """With holes of a pixel or two between points filled."""
    wide = torch.nn.functional.max_pool2d(torch.nn.functional.pad(drawn[:, None], (1,) * 4), 3, 1, 1)
    return -torch.nn.functional.max_pool2d(-wide, 3, 1, 1)[:, 0, 1:-1, 1:-1]


def turn_matrix(azimuth: Float[Tensor, "..."]) -> Float[Tensor, "... 3 3"]:
    """The turn about z."""
    c, s, o = azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)
    rows = [torch.stack(row, dim=-1) for row in ((c, -s, o), (s, c, o), (o, o, o + 1))]
    return torch.stack(rows, dim=-2)
