"""Warnings about one to three photos: what they leave open, and what keeps their masks from telling more."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

from gsopt.data.scene import Scene, View
from gsopt.geometry.focus import find_focus
from gsopt.init.thumbnails import Thumbnail, small_photos

MAX_FEW_PHOTOS = 3
"""Photos up to which a run warns."""
MIN_MASK_PIXELS = 64
"""Pixels below which a mask has no shape."""
MAX_COVERED = 0.98
"""Share of the image from which on a mask outlines nothing."""
MIN_ANGLE = 10.0
"""Degrees between the axes of two cameras below which they show the same side."""
NO_MASKS = (
    "{} input views without masks: sides that they do not show cannot be completed. Add alpha or a folder masks/ "
    "(docs/howto/photos.md), or more photos."
)
GUESSED = (
    "One photo shows one side: depth and the other sides are a guess, the silhouette inflated to a body in the photo's "
    "colors. A second photo from the side helps most."
)
LIKENED = GUESSED.replace("the silhouette inflated to a body", "shapes of a library, mixed,")
COMPLETED = (
    "A few photos show a few sides: shape and color of the others are a guess of a shape prior. Another photo from "
    "there helps most."
)
TURNED = (
    "One photo shows one side: the other sides are a guess. The silhouette is that of a thing which looks the same "
    "from all around an upright axis, and that is assumed. A second photo from the side tells."
)


def few_photo_warnings(scene: Scene) -> tuple[str, ...]:
    """Tells users of one to three photos what the photos leave open and what is wrong with their masks."""
    if len(scene.train) > MAX_FEW_PHOTOS:
        return ()
    if not scene.has_alpha:
        return (NO_MASKS.format(len(scene.train)),)
    photos = small_photos(scene.train, MAX_FEW_PHOTOS)
    faults = [fault for view, photo in zip(scene.train, photos, strict=True) for fault in _mask_faults(view, photo)]
    faults += _direction_faults(scene)
    if scene.completed:
        guess = GUESSED if scene.body is None else LIKENED if scene.body_colors is None else COMPLETED
        faults.append(guess if scene.guessed else TURNED)
    return tuple(faults)


def _mask_faults(view: View, photo: Thumbnail) -> Iterator[str]:
    solid = photo.planes[3] > 127
    pixels, share = int(solid.sum()), float(solid.double().mean())
    if pixels < MIN_MASK_PIXELS:
        yield f"The mask of {view.name} holds {pixels} pixels, too few for a shape. Check it, or leave it out."
    elif share > MAX_COVERED:
        yield f"The mask of {view.name} covers {share:.0%} of it and outlines nothing. Cut the object out."
    elif not photo.shows_all():
        yield f"{view.name} cuts the object off at its border: what lies beyond is not completed. Step back."


def _direction_faults(scene: Scene) -> Iterator[str]:
    cameras = [view.camera for view in scene.train]
    alike = False
    for a, b in itertools.combinations(scene.train, 2):
        cosine = float((a.camera.forwards[0] @ b.camera.forwards[0]).clamp(-1, 1))
        if (angle := math.degrees(math.acos(cosine))) < MIN_ANGLE:
            alike = True
            yield f"{a.name} and {b.name} look the same way within {angle:.0f} degrees: they show the same side."
    if len(cameras) > 1 and not alike and not find_focus(cameras, scene.extent).converging:
        yield "The cameras look apart, so that no two show the same object. Check the poses."
