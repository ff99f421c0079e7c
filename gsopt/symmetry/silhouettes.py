"""Agreement of silhouettes with a mirror plane, to fractions of a pixel.

Silhouettes of one object cohere: on the ray of every outline pixel lies a point that no other silhouette excludes
(Hernández, Schmitt & Cipolla 2007, who find cameras that way). If the object is symmetric, the silhouettes that its
mirror images would have must cohere with the photos' too. With s_v(x) the signed distance of x to the outline in view
v, in pixels and positive inside, and M the reflection, an outline pixel p of view i misses by

    (1)  r_p = max(0, -max over x on the ray of p of min over v of min(s_v(x), s_v(M x))).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsopt.geometry.projection import project
from gsopt.init.distances import squared_distance
from gsopt.init.thumbnails import Thumbnail, sample
from gsopt.symmetry.axis import Axis
from gsopt.symmetry.mirror import Mirror

RAYS_PER_PHOTO = 120
"""Outline pixels that are compared, evenly spaced."""
SAMPLES, FINER = 64, 9
"""Points along a ray, then more around the best of them."""
MAX_GRID_SIDE = 1024
"""Outlines, where alpha passes one half, lie on a grid 2 or 4 times finer than the pixels, up to this long."""
MAX_DISTANCE = 12
"""Distance from the outline at which the signed distance ends, px."""
EXCLUSION_SLACK = 1.5
"""Points are tried that the photos themselves exclude by no more than this, px."""
MIN_RAYS = 20
"""Rays per photo below which any mirror would fit."""
MAX_MISS = 4.0
"""Largest miss of a pixel, px: one that sees another part of the object must not decide alone."""


@dataclass(frozen=True)
class Outline:
    """One silhouette."""

    photo: Thumbnail
    distance: Float[Tensor, "1 FH FW"]
    """Signed, px, positive inside; on the finer grid."""

    @staticmethod
    def of(photo: Thumbnail) -> Outline:
        finer = 4 if 4 * max(photo.camera.width, photo.camera.height) <= MAX_GRID_SIDE else 2
        return Outline(photo, signed_distance(photo.alpha(), finer))

    def at(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """Signed distance of projected points, px; far outside behind the camera."""
        column, row, depth = project(self.photo.camera, points.reshape(-1, 3))
        before = depth > 1e-6
        column, row = (torch.where(before, coordinate, 0.0) for coordinate in (column, row))
        return torch.where(before, self.here(column, row), -float(MAX_DISTANCE)).view(points.shape[:-1])

    def here(self, column: Float[Tensor, "N"], row: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Signed distance at pixel coordinates, px."""
        finer = self.distance.shape[2] / self.photo.camera.width
        return sample(self.distance, finer * column, finer * row)[0]


@dataclass(frozen=True)
class RayPoints:
    """Some points on each ray."""

    points: Float[Tensor, "R S 3"]
    others: Float[Tensor, "R S"]
    """Their smallest signed distance in all photos but the ray's own, px."""


class Silhouettes:
    """Outlines of the photos and the rays through them, for the comparison with mirrors."""

    def __init__(self, photos: list[Thumbnail], center: Float[Tensor, "3"], radius: float) -> None:
        """All of the object lies within `radius` of `center`, scene units."""
        self.outlines = [Outline.of(photo) for photo in photos]
        rays = [_rays(outline, center, radius) for outline in self.outlines]
        self._origins, self._directions, self._depths = (torch.cat(parts) for parts in zip(*rays, strict=True))
        self._own = torch.cat([torch.full((len(origins),), row) for row, (origins, _, _) in enumerate(rays)])
        points = self._points(self._depths)
        others = self._among_others(points, self._own[:, None])
        self._kept = others > -EXCLUSION_SLACK
        self._kept_points, self._kept_others = points[self._kept], others[self._kept]

    @property
    def outline_something(self) -> bool:
        """False for opaque photos, whose alpha has no edge."""
        return len(self._origins) >= MIN_RAYS * len(self.outlines)

    def near_optima(self, mirror: Mirror | Axis) -> RayPoints:
        """Points around the x of (1) on the rays of all photos."""
        smallest = torch.full(self._kept.shape, -float(MAX_DISTANCE))
        smallest[self._kept] = torch.minimum(self._kept_others, self._behind(mirror, self._kept_points))
        # The best point lies between two samples.
        depth = self._depths.gather(1, smallest.argmax(1, keepdim=True))
        points = self._points(depth + torch.linspace(-1, 1, FINER) * (self._depths[:, 1:2] - self._depths[:, :1]))
        return RayPoints(points, self._among_others(points, self._own[:, None]))

    def misses(self, mirror: Mirror | Axis, near: RayPoints) -> Float[Tensor, "R"]:
        """(1) for the rays of all photos, px, at most MAX_MISS; x is sought among points near the optima of this mirror
        or of a similar one."""
        return (-torch.minimum(near.others, self._behind(mirror, near.points)).amax(1)).clamp(0, MAX_MISS)

    def _points(self, depths: Float[Tensor, "R S"]) -> Float[Tensor, "R S 3"]:
        return self._origins[:, None] + self._directions[:, None] * depths[..., None]

    def _among_others(self, points: Float[Tensor, "R S 3"], own: Int64[Tensor, "R 1"]) -> Float[Tensor, "R S"]:
        """The smallest signed distance in all photos but the ray's own."""
        smallest = torch.full(points.shape[:-1], float(MAX_DISTANCE))
        for index, outline in enumerate(self.outlines):
            smallest = torch.where(own == index, smallest, torch.minimum(smallest, outline.at(points)))
        return smallest

    def _behind(self, mirror: Mirror | Axis, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """The smallest signed distance of the points' images in all photos."""
        smallest = torch.full(points.shape[:-1], float(MAX_DISTANCE))
        for image in mirror.images(points):
            for outline in self.outlines:
                smallest = torch.minimum(smallest, outline.at(image))
        return smallest


def _rays(
    outline: Outline, center: Float[Tensor, "3"], radius: float
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"], Float[Tensor, "R S"]]:
    """Origins, directions and the depths of the samples of the rays through an outline's pixels."""
    camera = outline.photo.camera
    column, row = outline_pixels(outline)
    K, R, t = camera.Ks[0], camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    directions = x[:, None] * R[0] + y[:, None] * R[1] + R[2]
    middle = float((center * R[2]).sum() + t[2])
    depths = torch.linspace(max(middle - radius, 1e-3 * abs(middle)), middle + radius, SAMPLES)
    return camera.centers.expand(len(column), 3), directions, depths.expand(len(column), SAMPLES)


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


def outline_pixels(outline: Outline) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
    """Column and row of up to RAYS_PER_PHOTO points on an outline: pixels at the silhouette's edge, moved onto it. The
    border of the image, which cuts an object off, is no outline."""
    solid = outline.photo.alpha()[0] > 0.5
    beside = torch.nn.functional.max_pool2d((~solid)[None, None].float(), 3, 1, padding=1)[0, 0] > 0
    edge = torch.nonzero(solid & beside)
    edge = edge[:: max(1, math.ceil(len(edge) / RAYS_PER_PHOTO))]
    row, column = (edge + 0.5).unbind(1)
    for _ in range(2):
        here = outline.here(column, row)
        across = _slope(outline, column, row, 0.5, 0.0)
        down = _slope(outline, column, row, 0.0, 0.5)
        steep = (across**2 + down**2).clamp(min=0.25)
        column, row = column - here * across / steep, row - here * down / steep
    return column, row


def _slope(outline: Outline, column: Tensor, row: Tensor, across: float, down: float) -> Float[Tensor, "R"]:
    """Difference of the signed distance over one pixel."""
    return outline.here(column + across, row + down) - outline.here(column - across, row - down)
