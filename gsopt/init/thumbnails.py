"""Small copies of the input views, and their colors at projected points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.data.resample import downscaled_size, premultiplied_downscale, sample
from gsopt.data.scene import View
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.farthest_points import farthest_points
from gsopt.geometry.projection import inside, project

MAX_SIDE = 512
"""Longer side of the copies, px: enough to place and color the first Gaussians, and a bound on memory."""


@dataclass(frozen=True)
class Thumbnail:
    """A view, at most MAX_SIDE large."""

    camera: Cameras
    planes: UInt8[Tensor, "4 H W"]
    """Color times alpha, then alpha."""
    colored: bool = True
    """False when only its silhouette is reliable."""

    def alpha(self) -> Float[Tensor, "1 H W"]:
        """0..1."""
        return self.planes[3:].float() / 255

    def shows_all(self) -> bool:
        """True when there is a silhouette and it keeps off the border: nothing outside the image then belongs to the
        object."""
        solid = self.planes[3] > 127
        touches = any(bool(edge.any()) for edge in (solid[0], solid[-1], solid[:, 0], solid[:, -1]))
        return bool(solid.any()) and not touches


def small_photos(views: Sequence[View], most: int) -> list[Thumbnail]:
    """Copies of up to `most` views, those farthest apart when there are more, in the order of `views`."""
    rows = list(range(len(views)))
    if len(rows) > most:
        rows = sorted(farthest_points(torch.cat([view.camera.centers for view in views]), most))
    return [_small(views[row]) for row in rows]


def _small(view: View) -> Thumbnail:
    pixels = view.pixels()
    factor = max(1.0, max(pixels.shape[:2]) / MAX_SIDE)
    width, height = (downscaled_size(size, factor) for size in (pixels.shape[1], pixels.shape[0]))
    planes = (premultiplied_downscale(pixels, width, height) + 0.5).clamp(0, 255).to(torch.uint8)
    if len(planes) == 3:
        planes = torch.cat([planes, torch.full_like(planes[:1], 255)])
    return Thumbnail(view.camera.resized(width, height), planes, colored=view.color > 0)


def mean_colors(photos: list[Thumbnail], points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Mean color (0..1, alpha-weighted) over the photos that show a point; mid gray where none does."""
    total = torch.zeros(4, len(points))
    for photo in photos:
        column, row, depth = project(photo.camera, points)
        shown = torch.nonzero(inside(photo.camera, column, row, depth))[:, 0]
        total[:, shown] += sample(photo.planes.float(), column[shown], row[shown]) / 255
    return colors_from_sums(total)


def colors_from_sums(total: Float[Tensor, "4 N"]) -> Float[Tensor, "N 3"]:
    """Sums of premultiplied color and alpha to straight color; mid gray where the alpha is 0."""
    weight = total[3:]
    return torch.where(weight > 1e-6, total[:3] / weight.clamp(min=1e-6), 0.5).T.clamp(0, 1)
