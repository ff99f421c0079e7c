"""Outlines of masks, to fractions of a pixel: the line where alpha passes one half."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsopt.data.distances import squared_distance
from gsopt.data.lookup import Picture
from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras

PIXELS_PER_PHOTO = 120
"""Outline pixels that are compared, evenly spaced."""
MAX_GRID_SIDE = 1024
"""Outlines lie on a grid 2 or 4 times finer than the pixels, up to this long."""
MAX_DISTANCE = 12
"""Distance from the outline at which the signed distance ends, px."""


@dataclass(frozen=True)
class Outline:
    """One silhouette."""

    camera: Cameras
    alpha: Float[Tensor, "1 H W"]
    distance: Float[Tensor, "1 FH FW"]
    """Signed, px, positive inside; on the finer grid."""

    @staticmethod
    def of(camera: Cameras, alpha: Float[Tensor, "1 H W"]) -> Outline:
        finer = 4 if 4 * max(camera.width, camera.height) <= MAX_GRID_SIDE else 2
        return Outline(camera, alpha, signed_distance(alpha, finer))

    @cached_property
    def picture(self) -> Picture:
        """The signed distance, for lookups of points; far outside behind the camera."""
        return Picture(self.camera, self.distance[0], unseen=-float(MAX_DISTANCE))

    def here(self, column: Float[Tensor, "N"], row: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Signed distance at pixel coordinates, px."""
        finer = self.distance.shape[2] / self.camera.width
        return sample(self.distance, finer * column, finer * row)[0]

    def pixels(self) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Column and row of up to PIXELS_PER_PHOTO points on the outline: pixels at the silhouette's edge, moved onto
        it. The border of the image, which cuts an object off, is no outline."""
        solid = self.alpha[0] > 0.5
        beside = torch.nn.functional.max_pool2d((~solid)[None, None].float(), 3, 1, padding=1)[0, 0] > 0
        edge = torch.nonzero(solid & beside)
        edge = edge[_around(edge)][:: max(1, math.ceil(len(edge) / PIXELS_PER_PHOTO))]
        row, column = (edge + 0.5).unbind(1)
        for _ in range(2):
            here = self.here(column, row)
            across, down = self._slope(column, row, 0.5, 0.0), self._slope(column, row, 0.0, 0.5)
            steep = (across**2 + down**2).clamp(min=0.25)
            column, row = column - here * across / steep, row - here * down / steep
        return column, row

    def _slope(self, column: Tensor, row: Tensor, across: float, down: float) -> Float[Tensor, "R"]:
        """Difference of the signed distance over one pixel."""
        return self.here(column + across, row + down) - self.here(column - across, row - down)


def _around(places: Int64[Tensor, "R 2"]) -> Int64[Tensor, "R"]:
    """Their order around their middle. Row by row, every second one would often be that on the left."""
    down, across = (places - places.double().mean(0)).unbind(1)
    return torch.atan2(down, across).argsort(stable=True)


def signed_distance(alpha: Float[Tensor, "1 H W"], finer: int) -> Float[Tensor, "1 FH FW"]:
    """Signed distance to the line where alpha passes one half, px, positive inside, up to MAX_DISTANCE; the grid is
    `finer` than the pixels."""
    planes = torch.nn.functional.interpolate(alpha[None], scale_factor=finer, mode="bilinear", align_corners=False)[0]
    solid, reach = planes > 0.5, MAX_DISTANCE * finer
    distance = torch.full(solid.shape, 0.5 - reach)
    rows, columns = (_span(solid[0].any(1 - axis), reach) for axis in (0, 1))
    near = solid[:, rows, columns]  # all else is farther than that
    inner, outer = (squared_distance(other, reach).float().clamp(max=reach**2).sqrt() - 0.5 for other in (~near, near))
    distance[:, rows, columns] = torch.where(near, inner, -outer)
    return distance / finer


def _span(occupied: Bool[Tensor, "N"], margin: int) -> slice:
    """From the first true place to the last and a margin on both sides; empty where there is none."""
    places = torch.nonzero(occupied)[:, 0].tolist()
    return slice(max(0, places[0] - margin), places[-1] + margin + 1) if places else slice(0, 0)
