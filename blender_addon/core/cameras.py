"""The views of a dataset: picture, pose and lens, as Blender's cameras need them.

Poses are world_from_cam with Blender's and OpenGL's axes: x right, y up, looking along -z. COLMAP's are turned here.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import colmap
from .errors import InputError
from .files import is_text, read_json

LARGEST_FILE = 64 << 20
MOST_VIEWS = 20_000
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp")


@dataclass(frozen=True)
class View:
    """One picture and the camera that took it, a pinhole."""

    name: str
    image: Path
    split: str
    """train, test or val."""
    world_from_cam: NDArray[np.float64]
    """[4, 4] OpenGL axes."""
    width: int
    height: int
    """px; 0 where only the picture knows."""
    angle_x: float
    """Horizontal field of view, radians."""
    center: tuple[float, float] | None = None
    """Principal point, px; the middle when not given."""

    @property
    def shift(self) -> tuple[float, float]:
        """Blender's lens shift with sensor_fit HORIZONTAL: in widths, positive where the picture moves left or down."""
        if self.center is None or not self.width:
            return 0.0, 0.0
        x, y = self.center
        return (0.5 * self.width - x) / self.width, (y - 0.5 * self.height) / self.width


def read_views(data: Path) -> list[View]:
    """The views of a NeRF-synthetic, nerfstudio or COLMAP folder. InputError where there are none."""
    splits = [split for split in ("train", "test", "val") if (data / f"transforms_{split}.json").is_file()]
    if splits:
        return [view for split in splits for view in from_transforms(data / f"transforms_{split}.json", split)]
    if (data / "transforms.json").is_file():
        return from_transforms(data / "transforms.json", "train")
    sparse = colmap.model_folder(data)
    if sparse is not None:
        return from_colmap(data, sparse)
    raise InputError(f"{data} holds no posed views. Choose a dataset, or find the poses of the photos first.")


def from_transforms(path: Path, split: str) -> list[View]:
    """The frames of one transforms file. InputError names the frame that cannot be used."""
    document = read_json(path, LARGEST_FILE)
    frames = document.get("frames")
    if not isinstance(frames, list) or len(frames) > MOST_VIEWS:
        raise InputError(f"{path} needs a list `frames` of at most {MOST_VIEWS} views. Write it again.")
    views = []
    for number, frame in enumerate(frames):
        try:
            views.append(view_of(path.parent, {**document, **frame}, split))
        except (KeyError, ValueError, TypeError, ArithmeticError) as error:
            raise InputError(f"Frame {number} of {path} cannot be used: {error!r:.80}. Correct it.") from error
    return views


def view_of(folder: Path, values: dict[str, Any], split: str) -> View:
    pose = np.array(values["transform_matrix"], np.float64)
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("transform_matrix is no 4x4 matrix")
    width, height = int(values.get("w", 0)), int(values.get("h", 0))
    if not 0 <= width < 2**31 or not 0 <= height < 2**31 or not is_text(values["file_path"]):
        raise ValueError("w, h or file_path")
    focal = float(values["fl_x"]) if "fl_x" in values else 0.0
    angle = 2 * math.atan(0.5 * width / focal) if focal > 0 and width > 0 else float(values["camera_angle_x"])
    if not 0 < angle < math.pi:
        raise ValueError(f"a field of view of {angle} radians")
    center = (float(values["cx"]), float(values["cy"])) if {"cx", "cy", "w", "h"} <= set(values) else None
    if center is not None and not all(map(math.isfinite, center)):
        raise ValueError("cx or cy")
    image = find_image(folder, values["file_path"])
    return View(image.stem, image, split, pose, width, height, angle, center)


def find_image(folder: Path, name: str) -> Path:
    """The picture of a frame, whose suffix NeRF-synthetic leaves out; the path as it stands where there is none."""
    path = folder / name.replace("\\", "/")
    return next((p for p in (path.with_name(path.name + suffix) for suffix in SUFFIXES) if os.path.isfile(p)), path)


def from_colmap(data: Path, sparse: Path) -> list[View]:
    views = []
    for picture in colmap.read_pictures(sparse):
        world_from_cv = np.linalg.inv(picture.cam_from_world).astype(np.float64)
        angle = 2 * math.atan(0.5 * picture.width / picture.focal)
        image = data / "images" / picture.name
        size = picture.width, picture.height
        views.append(View(image.stem, image, "train", world_from_cv @ GL_FROM_CV, *size, angle, picture.center))
    return sorted(views, key=lambda view: view.image.as_posix())
