"""The mirrors of a scene, and the scene with the mirror images of its photos."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch

from gsopt.data.scene import Scene, View
from gsopt.errors import InputError
from gsopt.geometry.focus import find_focus
from gsopt.geometry.voxels import Grid
from gsopt.init.hull import carve, in_hull
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.symmetry.colors import disagreement
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import Ball, bounding_ball, candidates, refined, same
from gsopt.symmetry.silhouettes import Silhouettes

MAX_PHOTOS = 8
"""Silhouettes that are compared, the farthest apart: 4 suffice."""
MAX_MISSES = 0.014
"""A mirror is accepted if the outlines miss by no more than this over the number of photos (root mean square), in
radii of the object: the more the photos show themselves, the surer it must be to add to them."""
DISTINCT_ANGLE = 10.0
"""Mirrors nearer to each other than this are one, degrees."""
MAX_DISAGREEMENT = 0.45
"""Colors of mirror images count if they disagree by no more than this."""
MIRRORED_COLOR_WEIGHT = 0.3
"""Weight of their colors then: light falls on one side, and where a photo shows a point, the photo decides.
docs/decisions/0002-symmetry.md has the figures."""


@dataclass(frozen=True)
class Symmetry:
    """A mirror that an object has."""

    mirror: Mirror
    misses: float
    """Root mean square distance by which the outlines miss, in radii of the object as the photos show it."""
    disagreement: float
    """Disagreement of the colors: 0 for equal mirror images, 1 as between random points."""

    @property
    def colored(self) -> bool:
        """True when the paint is symmetric too."""
        return self.disagreement <= MAX_DISAGREEMENT

    @property
    def about(self) -> str:
        """One line for logs and reports."""
        x, y, z = self.mirror.normal.tolist()
        used = "shape and colors" if self.colored else "shape alone: the colors are not symmetric"
        return f"mirror plane ({x:.3f}, {y:.3f}, {z:.3f}) · x = {self.mirror.offset:.3g}, {used}"

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; `from_dict` is its inverse, to the bit."""
        plane = {"normal": self.mirror.normal.tolist(), "offset": self.mirror.offset}
        return {**plane, "misses": self.misses, "disagreement": self.disagreement, "about": self.about}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Symmetry:
        """KeyError, TypeError, ValueError or InputError for values that `to_dict` never writes."""
        numbers = [float(number) for number in (*values["normal"], values["offset"])]
        normal = torch.tensor(numbers[:-1])
        if len(normal) != 3 or not abs(float(normal.norm()) - 1) < 1e-4 or not math.isfinite(numbers[-1]):
            raise InputError(f"the plane: normal {normal.tolist()}, offset {numbers[-1]}")
        return Symmetry(Mirror(normal, numbers[-1]), float(values["misses"]), float(values["disagreement"]))


def find_symmetries(scene: Scene) -> list[Symmetry]:
    """The mirrors that the silhouettes of the input views agree on; empty unless every view has alpha."""
    if not scene.has_alpha or len(scene.train) < 2:
        return []
    photos = small_photos(scene.train, MAX_PHOTOS)
    grid = carve(photos, find_focus([photo.camera for photo in photos], scene.extent))
    if grid is None:
        return []
    ball = bounding_ball(grid)
    silhouettes = Silhouettes(photos, ball.center, ball.radius)
    if not silhouettes.outline_something:
        return []
    pixels = sum(_projected_radius(photo, ball) for photo in photos) / len(photos)
    most = MAX_MISSES / len(scene.train) * pixels
    found: list[Symmetry] = []
    for candidate in candidates(grid, photos, ball):
        mirror, misses = refined(candidate, silhouettes, ball, most)
        if misses <= most and not any(same(mirror, other.mirror, DISTINCT_ANGLE) for other in found):
            shape = _symmetric_part(grid, photos, mirror)
            found.append(Symmetry(mirror, misses / pixels, disagreement(shape, photos, mirror, ball.radius)))
    return found


def with_mirror_images(scene: Scene, symmetries: list[Symmetry]) -> Scene:
    """The scene with one more view per photo and mirror."""
    images = [mirror_image(view, symmetry) for symmetry in symmetries for view in scene.train]
    return replace(scene, mirrored=tuple(images))


def mirror_image(view: View, symmetry: Symmetry) -> View:
    """The view of the camera behind the mirror; only its outline counts unless the paint is symmetric."""
    camera = symmetry.mirror.camera(view.camera)
    color = MIRRORED_COLOR_WEIGHT if symmetry.colored else 0.0
    return replace(view, name=f"{view.name} (mirrored)", camera=camera, mirrored=True, color=color)


def _projected_radius(photo: Thumbnail, ball: Ball) -> float:
    """Radius of the ball in a photo, px."""
    distance = float((photo.camera.centers[0] - ball.center).norm())
    return ball.radius * float(photo.camera.Ks[0, 0, 0]) / max(distance, 1e-6)


def _symmetric_part(grid: Grid, photos: list[Thumbnail], mirror: Mirror) -> Grid:
    """The voxels whose mirror image every photo admits."""
    stays = in_hull(photos, mirror.reflect(grid.centers()))
    return replace(grid, occupied=grid.occupied.masked_scatter(grid.occupied, stays))
