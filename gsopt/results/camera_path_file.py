"""Camera paths in the JSON of nerfstudio: written, and read from files that nobody vouches for.

Source: nerfstudio, `render camera-path` and its documentation: `camera_path` is a list with `camera_to_world` (16
numbers, row by row, OpenGL axes), `fov` (vertical, degrees) and `aspect`; `render_width`, `render_height` and `fps`
stand beside it. Positions are in the frame of the dataset.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.errors import InputError, shortened
from gsopt.events import to_json, write_atomic
from gsopt.formats.units import NOWHERE, Point
from gsopt.geometry.cameras import Cameras, opengl_from_viewmats, viewmats_from_opengl

MAX_CAMERAS, MAX_SIDE = 100_000, 16384
MIN_FOV, MAX_FOV = 0.1, 179.0
"""Degrees."""
_RIGID = 1e-3


def write_camera_path(path: Path, cameras: list[Cameras], fps: float, origin: Point = NOWHERE) -> None:
    """Write cameras of one size; the principal point is taken to be the middle."""
    write_atomic(path, encoded_camera_path(cameras, fps, origin))


def encoded_camera_path(cameras: list[Cameras], fps: float, origin: Point = NOWHERE) -> bytes:
    """The bytes of such a file."""
    height, width = cameras[0].height, cameras[0].width
    entries = []
    for camera in cameras:
        pose = opengl_from_viewmats(camera.viewmats[0].double())
        pose[:3, 3] += torch.tensor(origin, dtype=torch.float64)
        fov = math.degrees(2 * math.atan(camera.height / 2 / float(camera.Ks[0, 1, 1])))
        entries.append({"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": width / height})
    document = {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        "camera_path": entries,
        "keyframes": [],
    }
    return to_json(document)


def read_camera_path(path: Path, origin: Point = NOWHERE) -> list[Cameras]:
    """The cameras of a file, in a scene whose positions are those of the dataset less `origin`."""
    found = files.read_json(path)
    width, height = (_integer(found, key, path) for key in ("render_width", "render_height"))
    if found.get("camera_type", "perspective") != "perspective":
        raise InputError(
            f"{path}: camera_type must be perspective, got {shortened(found['camera_type'])}. Export another."
        )
    entries = found.get("camera_path")
    if not isinstance(entries, list) or not 0 < len(entries) <= MAX_CAMERAS:
        raise InputError(f"{path} must have a list `camera_path` of 1 to {MAX_CAMERAS} cameras. Export it again.")
    return [_camera(entry, width, height, origin, f"camera_path[{i}] in {path}") for i, entry in enumerate(entries)]


def _camera(entry: Any, width: int, height: int, origin: Point, where: str) -> Cameras:
    fov = entry.get("fov") if isinstance(entry, dict) else None
    if not isinstance(fov, int | float) or isinstance(fov, bool) or not MIN_FOV <= fov <= MAX_FOV:
        raise InputError(f"{where} must have a `fov` of {MIN_FOV} to {MAX_FOV} degrees, got {shortened(fov)}. Mend it.")
    pose = _pose(entry.get("camera_to_world"), where)
    pose[:3, 3] -= torch.tensor(origin, dtype=torch.float64)
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(viewmats_from_opengl(pose)[None].float(), K[None], width, height)


def _pose(numbers: Any, where: str) -> Float[Tensor, "4 4"]:
    """A rotation and a translation from 16 numbers."""
    flat = isinstance(numbers, list) and len(numbers) == 16
    if not flat or not all(isinstance(x, int | float) and abs(x) < 1e30 for x in numbers):
        raise InputError(f"{where} must have 16 finite numbers `camera_to_world`. Export the path again.")
    pose = torch.tensor(numbers, dtype=torch.float64).view(4, 4)
    R = pose[:3, :3]
    rigid = torch.allclose(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=_RIGID)
    if not rigid or float(torch.linalg.det(R)) < 0 or pose[3].tolist() != [0, 0, 0, 1]:
        raise InputError(f"{where}: camera_to_world must be a rotation and a translation. Export the path again.")
    return pose


def _integer(found: dict[str, Any], key: str, path: Path) -> int:
    value = found.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= MAX_SIDE:
        raise InputError(f"{path}: {key} must be 1 to {MAX_SIDE}, got {shortened(value)}. Export the path again.")
    return value
