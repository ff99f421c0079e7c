"""Camera paths in the JSON of nerfstudio, as `gsopt render --path` reads and writes them.

A shot is world_from_cam with OpenGL's axes, which are Blender's, and a vertical field of view. Positions are in the
frame of the dataset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .files import read_json, write_json

LARGEST_FILE = 64 << 20
MOST_SHOTS = 20_000
MAX_SIDE = 16384
MIN_FOV, MAX_FOV = 0.1, 179.0
"""Degrees."""
_RIGID = 1e-3


@dataclass(frozen=True)
class CameraPath:
    """Cameras in time."""

    shots: list[tuple[NDArray[np.float64], float]]
    """world_from_cam [4, 4], and the vertical field of view in radians."""
    width: int
    height: int
    fps: float


def write_path(file: Path, path: CameraPath) -> None:
    """Write a whole file."""
    aspect = path.width / path.height
    entries = [
        {"camera_to_world": pose.ravel().tolist(), "fov": math.degrees(fov), "aspect": aspect}
        for pose, fov in path.shots
    ]
    document = {
        "camera_type": "perspective",
        "render_width": path.width,
        "render_height": path.height,
        "fps": path.fps,
        "seconds": len(entries) / path.fps,
        "camera_path": entries,
        "keyframes": [],
    }
    write_json(file, document)


def read_path(file: Path) -> CameraPath:
    """The cameras of a file. InputError names the entry that cannot be used."""
    found = read_json(file, LARGEST_FILE)
    entries = found.get("camera_path")
    if not isinstance(entries, list) or not 0 < len(entries) <= MOST_SHOTS:
        raise InputError(f"{file} needs a list `camera_path` of 1 to {MOST_SHOTS} cameras. Export it again.")
    sides = [found.get(key) for key in ("render_width", "render_height")]
    if not all(isinstance(side, int) and 1 <= side <= MAX_SIDE for side in sides):
        raise InputError(f"{file} needs render_width and render_height of 1 to {MAX_SIDE}. Export it again.")
    fps = found.get("fps", 24.0)
    if not isinstance(fps, int | float) or not 0.1 <= fps <= 1000:
        raise InputError(f"{file} needs fps of 0.1 to 1000. Export it again.")
    return CameraPath(
        [_shot(entry, f"Camera {row} of {file}") for row, entry in enumerate(entries)], *sides, float(fps)
    )


def _shot(entry: Any, where: str) -> tuple[NDArray[np.float64], float]:
    try:
        pose, fov = np.array(entry["camera_to_world"], np.float64).reshape(4, 4), float(entry["fov"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} needs `camera_to_world` of 16 numbers and `fov`. Export the path again.") from error
    R = pose[:3, :3]
    rigid = np.isfinite(pose).all() and np.allclose(R @ R.T, np.eye(3), rtol=0, atol=_RIGID)
    if not rigid or np.linalg.det(R) < 0 or not MIN_FOV <= fov <= MAX_FOV:
        raise InputError(f"{where} is no rotation, translation and fov of {MIN_FOV} to {MAX_FOV} degrees. Correct it.")
    return pose, math.radians(fov)
