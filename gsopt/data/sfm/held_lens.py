"""A lens that is held while photos are placed, and adjusted afterwards; several are tried where EXIF has none.

The first photos of a reconstruction say little about the focal length, least where all look at one point. A mapper that
adjusts it from three photos on loses it, and then finds no place for the fourth: 66 photos of a museum head, 4 degrees
apart, 200 to 1000 features in common with the next one, fell into 13 groups of 2 to 4 with focal lengths of 1.1 to 2.2
photo widths. With 1.9 or 1.2 held, all 66 are placed, and adjusted both become 1.9.
"""

from __future__ import annotations

from typing import Any

from gsopt.data.sfm.features import ColmapProject

FOCALS = (1.2, 1.9, 0.75)
"""Focal lengths tried where EXIF has none, in longer sides of the photo: 45, 30 and 67 degrees. All are adjusted."""
ERROR_SCALE = 1.5
"""Error at which an observation no longer speaks for a reconstruction, px."""


def focals_to_try(project: ColmapProject) -> list[float | None]:
    """One None if the database has all focal lengths from EXIF or the user."""
    with project.opened() as db:
        known = all(camera.has_prior_focal_length for camera in db.read_all_cameras())
    return [None] if known else list(FOCALS)


def guessed_lens(pycolmap: Any, camera: Any, focal: float) -> Any:
    """The camera without distortion, with a focal length in longer sides of the photo."""
    length = focal * max(camera.width, camera.height)
    guess = pycolmap.Camera.create_from_model_id(camera.camera_id, camera.model, length, camera.width, camera.height)
    guess.has_prior_focal_length = True  # otherwise the mapper replaces it by one from two photos
    return guess


def hold_lens(options: Any) -> None:
    """Lets an incremental mapper place photos and points alone."""
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False


def support(reconstruction: Any) -> float:
    """Sum over observations of max(0, 1 - (error / ERROR_SCALE)^2), after Torr and Zisserman 2000."""
    points = reconstruction.points3D.values()
    return sum(point.track.length() * max(0.0, 1 - (point.error / ERROR_SCALE) ** 2) for point in points)
