"""The points that at least two photos of a scene agree on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.scene import AgreedPoints, Scene
from gsopt.geometry.focus import Focus, find_focus
from gsopt.init.stereo.agreement import agreed
from gsopt.init.stereo.image import StereoImage
from gsopt.init.stereo.matching import Matcher
from gsopt.init.stereo.search import PlaneMap, Reach, Search, random_planes
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.cpu_backend import workspace
from gsopt.raster.threads import preparing_threads

MAX_PHOTOS = 16
"""Photos that are matched, the farthest apart."""
SOURCES_PER_PHOTO = 5
"""Others that each is matched with, the nearest."""
LEVELS = ((8_000, 8, 1.0), (32_000, 3, 0.02))
"""Pixels, rounds, and first step of the search: coarse in small images, exact in larger ones."""
NEAR_DEPTH, FAR_DEPTH = 0.25, 50.0
"""Depths that are searched, in distances to the focus."""


@dataclass(frozen=True)
class StereoMaps:
    """The planes that photos show, and where others confirm them."""

    maps: list[PlaneMap]
    kept: list[Bool[Tensor, "H W"]]

    def depths(self) -> list[Float[Tensor, "H W"]]:
        """Inverse depth along the camera's axis, NaN where no other photo agrees."""
        return [found.inverse_depths().masked_fill(~keep, torch.nan) for found, keep in self._pairs()]

    def points(self) -> AgreedPoints:
        """One for every pixel on which another photo agrees."""
        xyz = [found.image.points(found.inverse_depths())[keep] for found, keep in self._pairs()]
        rgb = [found.image.rgb.permute(1, 2, 0)[keep] for found, keep in self._pairs()]
        nothing = torch.empty(0, 3)
        agreed, pixels = torch.cat([*xyz, nothing]), sum(keep.numel() for keep in self.kept)
        return AgreedPoints(agreed, torch.cat([*rgb, nothing]), len(self.maps), len(agreed) / max(1, pixels))

    def _pairs(self) -> Iterator[tuple[PlaneMap, Bool[Tensor, "H W"]]]:
        return zip(self.maps, self.kept, strict=True)


def stereo_points(scene: Scene, count: int, generator: torch.Generator) -> AgreedPoints:
    """Up to `count` of the places on which photos agree, drawn at random. Fewer than two photos agree on none."""
    found = scene.agreed or match_photos(scene, generator).points()
    chosen = torch.randperm(len(found.xyz), generator=generator)[:count]
    return replace(found, xyz=found.xyz[chosen], rgb=found.rgb[chosen])


def match_photos(scene: Scene, generator: torch.Generator) -> StereoMaps:
    """Matches the input views with each other; a single one has none to be matched with."""
    photos = small_photos(scene.train, MAX_PHOTOS)
    focus = find_focus([view.camera for view in scene.train], scene.extent)
    maps = plane_maps(photos, focus, generator) if len(photos) > 1 else []
    return StereoMaps(maps, agreed(maps))


def plane_maps(photos: Sequence[Thumbnail], focus: Focus, generator: torch.Generator) -> list[PlaneMap]:
    """The planes that the pixels of each photo show, confirmed by others or not."""
    reach = Reach(1 / (FAR_DEPTH * focus.distance), 1 / (NEAR_DEPTH * focus.distance))
    threads = workspace(preparing_threads())
    maps: list[PlaneMap] = []
    for pixels, rounds, shake in LEVELS:
        images = [StereoImage.of(photo, pixels) for photo in photos]
        starts = [
            maps[index].enlarged(image) if maps else random_planes(image, reach, generator)
            for index, image in enumerate(images)
        ]
        maps = []
        for image, start in zip(images, starts, strict=True):
            matcher = Matcher(image, nearest(image, images, focus), threads)
            maps.append(Search(image, matcher, reach, start).run(rounds, shake, generator))
    return maps


def nearest(image: StereoImage, images: Sequence[StereoImage], focus: Focus) -> list[StereoImage]:
    """The others that most likely show the same: near in position and direction."""

    def distance(other: StereoImage) -> float:
        away = (other.camera.centers[0] - image.camera.centers[0]).norm()
        turned = 1 - (other.camera.forwards[0] * image.camera.forwards[0]).sum()
        return float(away + 2 * focus.distance * turned)

    return sorted((other for other in images if other is not image), key=distance)[:SOURCES_PER_PHOTO]
