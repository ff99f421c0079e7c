"""Agreement of silhouettes with a mirror plane, to fractions of a pixel.

Silhouettes of one object cohere: on the ray of every outline pixel lies a point that no other silhouette excludes
(Hernández, Schmitt & Cipolla 2007, who find cameras that way). If the object is symmetric, the silhouettes that its
mirror images would have must cohere with the photos' too. With s_v(x) the signed distance of x to the outline in view
v, in pixels and positive inside, and M the reflection, an outline pixel p of view i misses by

    (1)  r_p = max(0, -max over x on the ray of p of min over v of min(s_v(x), s_v(M x))).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.lookup import lowest
from gsopt.data.outlines import MAX_DISTANCE, Outline
from gsopt.init.thumbnails import Thumbnail
from gsopt.symmetry.axis import Axis
from gsopt.symmetry.mirror import Mirror

SAMPLES, FINER = 64, 9
"""Points along a ray, then more around the best of them."""
EXCLUSION_SLACK = 1.5
"""Points are tried that the photos themselves exclude by no more than this, px."""
MIN_RAYS = 20
"""Rays per photo below which any mirror would fit."""
MAX_MISS = 4.0
"""Largest miss of a pixel, px: one that sees another part of the object must not decide alone."""


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
        self.outlines = [Outline.of(photo.camera, photo.alpha()) for photo in photos]
        rays = [_rays(outline, center, radius) for outline in self.outlines]
        self._origins, self._directions, self._depths = (torch.cat(parts) for parts in zip(*rays, strict=True))
        self._counts = [len(origins) for origins, _, _ in rays]
        self._pictures = [outline.picture for outline in self.outlines]
        points = self._points(self._depths)
        others = self._among_others(points)
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
        return RayPoints(points, self._among_others(points))

    def misses(self, mirror: Mirror | Axis, near: RayPoints) -> Float[Tensor, "R"]:
        """(1) for the rays of all photos, px, at most MAX_MISS; x is sought among points near the optima of this mirror
        or of a similar one."""
        return (-torch.minimum(near.others, self._behind(mirror, near.points)).amax(1)).clamp(0, MAX_MISS)

    def _points(self, depths: Float[Tensor, "R S"]) -> Float[Tensor, "R S 3"]:
        return self._origins[:, None] + self._directions[:, None] * depths[..., None]

    def _among_others(self, points: Float[Tensor, "R S 3"]) -> Float[Tensor, "R S"]:
        """The smallest signed distance in all photos but the ray's own."""
        if len(self._pictures) == 1:
            return torch.full(points.shape[:-1], float(MAX_DISTANCE))
        rest = (self._pictures[:own] + self._pictures[own + 1 :] for own in range(len(self._pictures)))
        rays = points.split(self._counts)
        return torch.cat([lowest(others, own)[0] for others, own in zip(rest, rays, strict=True)])

    def _behind(self, mirror: Mirror | Axis, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """The smallest signed distance of the points' images in all photos."""
        images = torch.stack(list(mirror.images(points)))
        return lowest(self._pictures, images)[0].amin(0)


def _rays(
    outline: Outline, center: Float[Tensor, "3"], radius: float
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"], Float[Tensor, "R S"]]:
    """Origins, directions and the depths of the samples of the rays through an outline's pixels."""
    camera = outline.camera
    column, row = outline.pixels()
    K, R, t = camera.Ks[0], camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    directions = x[:, None] * R[0] + y[:, None] * R[1] + R[2]
    middle = float((center * R[2]).sum() + t[2])
    depths = torch.linspace(max(middle - radius, 1e-3 * abs(middle)), middle + radius, SAMPLES)
    return camera.centers.expand(len(column), 3), directions, depths.expand(len(column), SAMPLES)
