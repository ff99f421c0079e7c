"""Known poses: kept as they are, with points from triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.data.posed_images import PosedImage
from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import incremental_options
from gsopt.errors import InputError


def write_cameras(project: ColmapProject, frames: Sequence[PosedImage]) -> None:
    """Put the known lens of each frame (by name) into the database, in place of the guess from EXIF."""
    known = {Path(frame.name).name: frame for frame in frames}
    with project.opened() as db:
        cameras = {camera.camera_id: camera for camera in db.read_all_cameras()}
        for image in db.read_all_images():
            frame = known[image.name]
            camera = cameras[image.camera_id]
            model, params = lens_parameters(frame)
            exact = project.pycolmap.Camera(
                camera_id=camera.camera_id, model=model, width=frame.width, height=frame.height, params=params
            )
            exact.has_prior_focal_length = True
            db.update_camera(exact)


def triangulate(project: ColmapProject, frames: Sequence[PosedImage]) -> Any:
    """A reconstruction with exactly the given poses and lenses, and the points their matches agree on."""
    pycolmap = project.pycolmap
    known = {Path(frame.name).name: frame for frame in frames}
    reconstruction = pycolmap.Reconstruction()
    with project.opened() as db:
        for camera in db.read_all_cameras():
            reconstruction.add_camera_with_trivial_rig(camera)
        for image in db.read_all_images():
            pose = known[image.name].viewmat[:3].numpy()
            reconstruction.add_image_with_trivial_frame(
                pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id),
                pycolmap.Rigid3d(np.ascontiguousarray(pose)),
            )
    target = project.database.with_name("prior")
    target.mkdir()
    pycolmap.set_random_seed(project.config.seed)
    options = incremental_options(project)
    return pycolmap.triangulate_points(reconstruction, project.database, project.photos, target, options=options)


def lens_parameters(frame: PosedImage) -> tuple[str, list[float]]:
    """COLMAP's model name and parameters of a frame's lens. InputError where COLMAP has no model for it."""
    lens, K = frame.lens, frame.K
    pinhole = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
    if lens.is_pinhole:
        return "PINHOLE", pinhole
    radial = [*lens.radial, 0.0, 0.0, 0.0, 0.0][:4]
    if lens.fisheye and not any((*lens.tangential, *lens.prism, *lens.divisor)):
        return "OPENCV_FISHEYE", [*pinhole, *radial]
    if not lens.fisheye and not any((*lens.prism, *lens.divisor, radial[3])):
        k1, k2, k3, _ = radial
        return "FULL_OPENCV", [*pinhole, k1, k2, *lens.tangential, k3, 0.0, 0.0, 0.0]
    raise InputError(f"The lens of {frame.name} has terms that cannot be kept ({lens}). Undistort the photos first.")


def camera_key(frame: PosedImage) -> str:
    """Frames with the same text share a camera."""
    model, params = lens_parameters(frame)
    return f"{model} {frame.width}x{frame.height} {params}"
