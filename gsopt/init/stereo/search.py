"""PatchMatch stereo (Bleyer et al. 2011; Galliani et al. 2015): random planes, the good ones of which spread."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.init.stereo.image import StereoImage
from gsopt.init.stereo.matching import Matcher

BEST_SOURCES = 1
"""Sources that count, those that match best: with few photos most do not show a point."""
FAR_NEIGHBORS = (7, 5, 3, 2)
"""Pixels to the second ring of neighbors in the first rounds; a ring at distance 1 is always tried."""
FIRST_STEP = 0.3
"""First random step of the inverse depth, in the range that is searched; halved every round."""
_FORBIDDEN_COST = 9.0


@dataclass(frozen=True)
class Reach:
    """The inverse depths that are searched, 1 / scene units."""

    far: float
    near: float


@dataclass(frozen=True)
class PlaneMap:
    """The plane that each pixel of an image shows."""

    image: StereoImage
    planes: Float[Tensor, "3 H W"]
    """Inverse depth a x + b y + c of the ray (x, y, 1)."""
    costs: Float[Tensor, "H W"]
    """One minus the correlation, 0 to 2; more for no match."""

    def inverse_depths(self) -> Float[Tensor, "H W"]:
        return at(self.planes, self.image.rays)

    def enlarged(self, image: StereoImage) -> Float[Tensor, "3 H W"]:
        """The planes for a larger copy of the image."""
        size = (image.camera.height, image.camera.width)
        return torch.nn.functional.interpolate(self.planes[None], size, mode="nearest")[0]


def at(planes: Float[Tensor, "3 H W"], rays: Float[Tensor, "2 H W"]) -> Float[Tensor, "H W"]:
    """The inverse depth of each pixel's plane there."""
    return planes[0] * rays[0] + planes[1] * rays[1] + planes[2]


def random_planes(image: StereoImage, reach: Reach, generator: torch.Generator) -> Float[Tensor, "3 H W"]:
    """Uniform in inverse depth, slopes normal."""
    x, y = image.rays
    w = reach.far + (reach.near - reach.far) * torch.rand(x.shape, generator=generator)
    a, b = torch.randn(2, *x.shape, generator=generator) * w
    return torch.stack([a, b, w - a * x - b * y])


class Search:
    """Randomized search for the planes of one image."""

    def __init__(self, image: StereoImage, matcher: Matcher, reach: Reach, planes: Float[Tensor, "3 H W"]) -> None:
        self._image, self._matcher, self._reach = image, matcher, reach
        self._planes = planes
        self._costs = self._cost(planes)

    def run(self, rounds: int, shake: float, generator: torch.Generator) -> PlaneMap:
        """Tries the neighbors' planes, then random changes, in halving steps of the inverse depth."""
        for turn in range(rounds):
            far = FAR_NEIGHBORS[turn] if turn < len(FAR_NEIGHBORS) else 1
            for step in (1, far):
                for shift in ((0, step), (0, -step), (step, 0), (-step, 0)):
                    self._consider(torch.roll(self._planes, shift, (1, 2)))
            self._shake(shake / 2**turn, turn < 2, generator)
        return PlaneMap(self._image, self._planes, self._costs)

    def _shake(self, scale: float, tilt_both: bool, generator: torch.Generator) -> None:
        """Large steps, then small ones with a tilt."""
        x, y = self._image.rays
        steps = FIRST_STEP * scale * (self._reach.near - self._reach.far)
        for step, tilts in ((steps, tilt_both), (steps / 5, True)):
            w = at(self._planes, self._image.rays)
            moved = w + step * torch.randn(w.shape, generator=generator)
            slopes = self._planes[:2]
            if tilts:
                slopes = slopes + scale * w * torch.randn(slopes.shape, generator=generator)
            self._consider(torch.cat([slopes, (moved - slopes[0] * x - slopes[1] * y)[None]]))

    def _consider(self, planes: Float[Tensor, "3 H W"]) -> None:
        costs = self._cost(planes)
        better = costs < self._costs
        self._planes = torch.where(better, planes, self._planes)
        self._costs = torch.where(better, costs, self._costs)

    def _cost(self, planes: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
        w = at(planes, self._image.rays)
        within = (w > self._reach.far) & (w < self._reach.near)
        costs = self._matcher.costs(planes).sort(0).values[:BEST_SOURCES].sum(0) / BEST_SOURCES
        return torch.where(within, costs, _FORBIDDEN_COST)
