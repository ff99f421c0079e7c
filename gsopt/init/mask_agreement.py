"""Masks checked against each other: the silhouettes of one object fill the projections of their common hull.

With H(A) the visual hull of a set A of masks and c_j(A) the share of silhouette j that the projection of H(A) covers,
c_j = 1 for all j where all masks are right, since every silhouette contains the projection of the hull, and touches it
from inside along its whole outline (Laurentini 1994). A mask that shows too much lowers its own c; one that lost a
part of the object carves the hull and lowers the c of all others. In both cases the others agree without it: that is
how it is found, and told from the right ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import inside, project
from gsopt.geometry.voxels import Grid
from gsopt.init.hull import admits, spread
from gsopt.init.thumbnails import Thumbnail

MIN_MASKS = 3
"""Masks from which on a wrong one is told from right ones."""
MIN_COVERED = 0.95
"""Share of a silhouette that the hull of agreeing masks covers at least. The masks of renders and of a museum's photos
reach 0.99 on this grid."""
COARSE_SIDE, FINE_SIDE = 40, 72
"""Voxels along each side of the box that the cameras look at, and of the box that holds the object."""
LEAST_AGREEING = 0.4
"""Share of the masks that must agree, and 3 of 4. Wrong ones that show too much carve nothing and are in nobody's way:
a network took the plinth along in 4 of 8 photos."""
MAX_EXCLUSIONS = 1 / 3
"""Share of the masks that may carve a voxel away while the object's box is looked for."""


@dataclass(frozen=True)
class Voxels:
    """Cubic voxels that may belong to the object, and the masks that exclude each."""

    centers: Float[Tensor, "N 3"]
    size: float
    """Edge, scene units."""
    excluded: Bool[Tensor, "V N"]

    @property
    def reach(self) -> float:
        """Radius of a ball around a voxel."""
        return self.size * math.sqrt(3) / 2

    def hull(self, masks: list[int]) -> Float[Tensor, "M 3"]:
        """Centers of the voxels that none of these masks excludes."""
        return self.centers[~self.excluded[masks].any(0)] if masks else self.centers


@dataclass(frozen=True)
class Agreement:
    """Masks that agree with each other, and the hull of them."""

    agreeing: list[int]
    """Rows of the photos."""
    covered: list[float]
    """For every photo the share of its silhouette that the hull of the agreeing masks covers."""
    voxels: Voxels
    photos: list[Thumbnail]

    @property
    def disagreeing(self) -> list[int]:
        """Rows of the others, but for photos that the object fills: there a mask without an edge is right."""
        others = (row for row in range(len(self.photos)) if row not in self.agreeing)
        return [row for row in others if has_edge(self.photos[row]) or self.covered[row] < MIN_COVERED]

    def projection(self, row: int) -> Bool[Tensor, "H W"]:
        """Pixels of a photo that show the hull of the agreeing masks, its own left out."""
        others = [other for other in self.agreeing if other != row]
        return shadow(self.photos[row], self.voxels.hull(others), self.voxels.size)

    def thickness(self, row: int) -> Float[Tensor, "H W"]:
        """Thickness of that hull along the ray of each pixel, over its mean where there is some."""
        photo, others = self.photos[row], [other for other in self.agreeing if other != row]
        camera, hull = photo.camera, self.voxels.hull(others)
        column, row_, depth = project(camera, hull)
        seen = inside(camera, column, row_, depth)
        pixel = _pixel(row_[seen], camera.height) * camera.width + _pixel(column[seen], camera.width)
        counts = torch.bincount(pixel, minlength=camera.height * camera.width).view(1, 1, camera.height, -1).float()
        reach = math.ceil(
            0.75 * self.voxels.size * float(camera.Ks[0].diagonal()[:2].max()) / float(depth[seen].median())
        )
        thick = torch.nn.functional.avg_pool2d(counts, 2 * reach + 1, 1, reach)[0, 0]
        return thick / thick[thick > 0].mean()

    def admits_mask(self, photo: Thumbnail) -> bool:
        """True when the agreeing silhouettes stay covered after this mask has carved the hull too."""
        hull = self.voxels.hull(self.agreeing)
        kept = admits(photo, hull, self.voxels.reach)
        return all(
            _covered_share(self.photos[row], hull[kept], self.voxels.size) >= MIN_COVERED for row in self.agreeing
        )


def mask_agreement(photos: list[Thumbnail], focus: Focus) -> Agreement | None:
    """The largest agreement found by leaving out masks one by one, always the one without which the others agree best.
    Returns None for fewer than MIN_MASKS masks, or where too few agree."""
    if len(photos) < MIN_MASKS:
        return None
    voxels = _voxels(photos, focus)
    agreeing = [row for row in range(len(photos)) if has_edge(photos[row])]
    while len(agreeing) >= max(min(MIN_MASKS, len(photos) - 1), math.ceil(LEAST_AGREEING * len(photos))):
        covered = _covered(photos, voxels, agreeing, agreeing)
        if min(covered) >= MIN_COVERED:
            voxels = _around(photos, voxels.hull(agreeing), voxels.size)
            everyone = list(range(len(photos)))
            return Agreement(agreeing, _covered(photos, voxels, agreeing, everyone), voxels, photos)
        agreeing = _without_worst(voxels, photos, agreeing)
    return None


def has_edge(photo: Thumbnail) -> bool:
    """False for a mask that is empty or covers all: it says nothing about a shape."""
    solid = photo.planes[3] > 127
    return bool(solid.any()) and not bool(solid.all())


def _without_worst(voxels: Voxels, photos: list[Thumbnail], agreeing: list[int]) -> list[int]:
    """The rows but for the one without which the others agree best. If several would do, it is one that lacks
    something itself, or with which all others do."""
    shares = _covered(photos, voxels, agreeing, agreeing)
    lacking = {row for row, share in zip(agreeing, shares, strict=True) if share < MIN_COVERED}

    def fault(left_out: int) -> tuple[float, int]:
        rest = [row for row in agreeing if row != left_out]
        unlike = min(len(lacking ^ {left_out}), len(lacking ^ set(rest)))
        return -round(sum(_covered(photos, voxels, rest, rest)), 2), unlike

    worst = min(agreeing, key=fault)
    return [row for row in agreeing if row != worst]


def _covered(photos: list[Thumbnail], voxels: Voxels, masks: list[int], rows: list[int]) -> list[float]:
    """c_j of the photos in `rows` for the hull of `masks`."""
    hull = voxels.hull(masks)
    return [_covered_share(photos[row], hull, voxels.size) for row in rows]


def _covered_share(photo: Thumbnail, hull: Float[Tensor, "N 3"], size: float) -> float:
    """c_j; 0 for an empty silhouette."""
    solid = photo.planes[3] > 127
    return float((shadow(photo, hull, size) & solid).sum()) / max(1, int(solid.sum()))


def shadow(photo: Thumbnail, points: Float[Tensor, "N 3"], size: float) -> Bool[Tensor, "H W"]:
    """Pixels that voxels of this edge cover, widened by up to a voxel."""
    camera = photo.camera
    column, row, depth = project(camera, points)
    seen = inside(camera, column, row, depth)
    image = torch.zeros(1, camera.height, camera.width)
    if not bool(seen.any()):
        return image[0] > 0
    image[0, _pixel(row[seen], camera.height), _pixel(column[seen], camera.width)] = 1
    reach = math.ceil(0.75 * size * float(camera.Ks[0].diagonal()[:2].max()) / float(depth[seen].median()))
    return spread(image, reach)[0] > 0


def _pixel(coordinate: Float[Tensor, "N"], size: int) -> Int64[Tensor, "N"]:
    return coordinate.long().clamp(0, size - 1)


def _voxels(photos: list[Thumbnail], focus: Focus) -> Voxels:
    """Voxels of the box that most masks leave, with the masks that exclude each."""
    coarse = _excluded(photos, focus.point - 2 * focus.radius, torch.full((3,), 4 * focus.radius), COARSE_SIDE)
    kept = coarse.centers[coarse.excluded.sum(0) <= MAX_EXCLUSIONS * len(photos)]
    if len(kept) == 0:
        return coarse
    return _around(photos, kept, coarse.size)


def _around(photos: list[Thumbnail], centers: Float[Tensor, "M 3"], size: float) -> Voxels:
    """Finer voxels in the box of larger ones of this edge."""
    low, high = centers.amin(0) - size, centers.amax(0) + size
    return _excluded(photos, low, high - low, FINE_SIDE)


def _excluded(photos: list[Thumbnail], low: Float[Tensor, "3"], extent: Float[Tensor, "3"], side: int) -> Voxels:
    """About side³ voxels that fill a box."""
    size = float(extent.prod()) ** (1 / 3) / side
    shape = [math.ceil(float(length) / size) for length in extent]
    centers = Grid(torch.ones(shape, dtype=torch.bool), low, size).all_centers()
    reach = size * math.sqrt(3) / 2
    excluded = [~admits(photo, centers, reach) for photo in photos]
    return Voxels(centers, size, torch.stack(excluded))
