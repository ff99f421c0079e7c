"""The symmetries of a scene, and the scene with the images of its photos that they make."""

from __future__ import annotations

from dataclasses import replace

from gsopt.data.scene import Scene, View
from gsopt.geometry.focus import find_focus
from gsopt.init.hull import carve
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.symmetry.colors import disagreement
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import (
    CANDIDATE_ANGLE,
    DIRECTIONS,
    Ball,
    bounding_ball,
    candidates,
    half_sphere,
    refined,
    same,
)
from gsopt.symmetry.silhouettes import Silhouettes
from gsopt.symmetry.symmetry import MIRRORED_COLOR_WEIGHT, Symmetry, symmetric_part
from gsopt.symmetry.upright import FEW_PHOTOS, upright_symmetries

MAX_PHOTOS = 8
"""Silhouettes that are compared, the farthest apart: 4 suffice."""
MAX_MISSES = 0.014
"""A mirror is accepted if the outlines miss by no more than this over the number of photos (root mean square), in
radii of the object: the more the photos show themselves, the surer it must be to add to them."""
DISTINCT_ANGLE = 10.0
"""Mirrors nearer to each other than this are one, degrees."""


def find_symmetries(scene: Scene) -> list[Symmetry]:
    """The symmetries that the silhouettes of the input views agree on; empty unless every view has alpha."""
    if not scene.has_alpha:
        return []
    photos = small_photos(scene.train, MAX_PHOTOS)
    focus = find_focus([photo.camera for photo in photos], scene.extent)
    grid = carve(photos, focus)
    if grid is None:
        return []
    if len(photos) <= FEW_PHOTOS:
        return upright_symmetries(photos, focus, grid)
    ball = bounding_ball(grid)
    silhouettes = Silhouettes(photos, ball.center, ball.radius)
    if not silhouettes.outline_something:
        return []
    pixels = sum(_projected_radius(photo, ball) for photo in photos) / len(photos)
    most = MAX_MISSES / len(scene.train) * pixels
    mirrors: list[Mirror] = []
    found: list[Symmetry] = []
    for candidate in candidates(grid, photos, ball, half_sphere(DIRECTIONS), CANDIDATE_ANGLE):
        mirror, misses = refined(candidate, silhouettes, ball, most)
        if misses <= most and not any(same(mirror, other, DISTINCT_ANGLE) for other in mirrors):
            mirrors.append(mirror)
            shape = symmetric_part(grid, photos, mirror)
            found.append(Symmetry(mirror, misses / pixels, disagreement(shape, photos, mirror, ball.radius)))
    return found


def with_mirror_images(scene: Scene, symmetries: list[Symmetry]) -> Scene:
    """The scene with one more view per photo and mirror, or turn about an axis. Only outlines count there unless the
    paint is symmetric too, or nothing can tell: of a single photo."""
    images: list[View] = []
    for symmetry in symmetries:
        color = MIRRORED_COLOR_WEIGHT if symmetry.colored or len(scene.train) == 1 else 0.0
        images += [image for view in scene.train for image in symmetry.images(view, color)]
    return replace(scene, mirrored=tuple(images))


def _projected_radius(photo: Thumbnail, ball: Ball) -> float:
    """Radius of the ball in a photo, px."""
    distance = float((photo.camera.centers[0] - ball.center).norm())
    return ball.radius * float(photo.camera.Ks[0, 0, 0]) / max(distance, 1e-6)
