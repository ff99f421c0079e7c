"""Datasets described by JSON: NeRF-synthetic (Blender), nerfstudio and instant-ngp.

Poses are camera-to-world in OpenGL axes. `transforms_train.json` makes a folder NeRF-synthetic, `transforms.json`
nerfstudio; both kinds may carry explicit intrinsics, as BlenderNeRF writes them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.data.images import read_header
from gsopt.data.lens import Lens
from gsopt.data.pointcloud import read_points_ply
from gsopt.data.posed_images import Dataset, PosedImage, check_enough, read_pose, summarize_names
from gsopt.errors import InputError
from gsopt.geometry.cameras import intrinsics, viewmats_from_opengl

IMAGE_EXTENSIONS = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG")
_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")


def read_transforms(root: Path) -> Dataset:
    """Read a folder that has transforms_train.json or transforms.json. Raises InputError."""
    synthetic = files.is_regular(root / "transforms_train.json")
    path = root / ("transforms_train.json" if synthetic else "transforms.json")
    document = files.read_json(path)
    warnings: list[str] = []
    frames, absent = read_frames(document, path, warnings)
    check_enough(frames, absent, path)
    held_out: list[PosedImage] | None = None
    for name in ("transforms_test.json", "transforms_val.json"):
        if held_out is None and files.is_regular(root / name):
            held_out = read_frames(files.read_json(root / name), root / name, warnings)[0] or None
    if held_out is None and isinstance(document.get("test_filenames"), list):
        held_out, frames = _pick_test(frames, document, root)
    if not synthetic:
        frames.sort(key=lambda frame: frame.name)
    xyz, rgb = _points(document, root, warnings)
    return Dataset("nerf-synthetic" if synthetic else "nerfstudio", frames, held_out, xyz, rgb, warnings)


def read_frames(document: dict[str, Any], path: Path, warnings: list[str]) -> tuple[list[PosedImage], list[str]]:
    """The frames whose image exists, in file order, and the names of the others, reported in `warnings`."""
    entries = document.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path} has no list `frames` with at least one entry. Export the dataset again.")
    frames: list[PosedImage] = []
    absent: list[str] = []
    for position, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise InputError(f"{path}: frames[{position}] must be an object with a string `file_path`. Correct it.")
        image = _find_image(path.parent, entry["file_path"])
        if image is None:
            absent.append(entry["file_path"])
        else:
            frames.append(_frame(document, entry, position, image, path, warnings))
    if absent:
        warnings.append(
            f"{path.name} names {len(entries)} frames, the images of {len(absent)} are absent and left out: "
            f"{summarize_names(absent)}."
        )
    return frames, absent


def _find_image(root: Path, file_path: str) -> Path | None:
    path = files.child(root, file_path)
    if files.is_regular(path):
        return path
    for extension in IMAGE_EXTENSIONS:
        candidate = path.parent / (path.name + extension)
        if files.is_regular(candidate):
            return candidate
    return None


def _frame(
    document: dict[str, Any], entry: dict[str, Any], position: int, image: Path, path: Path, warnings: list[str]
) -> PosedImage:
    where = f"frame {entry['file_path']!r} in {path}"
    values = {**{key: value for key, value in document.items() if key != "frames"}, **entry}
    width, height = _size(values, image, where)
    mask = None
    if isinstance(entry.get("mask_path"), str):
        mask = files.child(path.parent, entry["mask_path"])
        if not files.is_regular(mask):
            names = summarize_names([entry["mask_path"]]), summarize_names([entry["file_path"]])
            warnings.append(f"The mask {names[0]} of {names[1]} is absent; the image is used unmasked.")
            mask = None
    return PosedImage(
        name=files.relative_name(image, path.parent),
        path=image,
        mask=mask,
        viewmat=viewmats_from_opengl(read_pose(entry, "transform_matrix", where)),
        K=_intrinsics(values, width, height, where),
        width=width,
        height=height,
        lens=_lens(values, where),
        position=position,
    )


def _size(values: dict[str, Any], image: Path, where: str) -> tuple[int, int]:
    if "w" not in values or "h" not in values:
        width, height, _ = read_header(image)
        return width, height
    width, height = (round(files.number(values[key], f"`{key}` of {where}")) for key in ("w", "h"))
    if width < 1 or height < 1:
        raise InputError(f"`w` and `h` of {where} must be at least 1, got {width} and {height}. Correct the file.")
    return width, height


def _intrinsics(values: dict[str, Any], width: int, height: int, where: str) -> Float[Tensor, "3 3"]:
    """From fl_x, fl_y, cx, cy, else from camera_angle_x (radians across the width), square pixels, centered."""

    def read(key: str, default: float) -> float:
        return files.number(values[key], f"`{key}` of {where}") if key in values else default

    if "fl_x" in values:
        focal_x = read("fl_x", 0.0)
        K = torch.eye(3, dtype=torch.float64)
        K[0, 0], K[1, 1] = focal_x, read("fl_y", focal_x)
        K[0, 2], K[1, 2] = read("cx", width / 2), read("cy", height / 2)
        if min(K[0, 0], K[1, 1]) <= 0:
            raise InputError(
                f"`fl_x` and `fl_y` of {where} must be positive, got {focal_x}, {K[1, 1]}. Correct the file."
            )
        return K
    if "camera_angle_x" not in values:
        raise InputError(f"The {where} has neither `fl_x` nor `camera_angle_x`. Add the focal length in pixels.")
    angle = read("camera_angle_x", 0.0)
    if not 1e-6 < angle < 3.14:
        raise InputError(f"`camera_angle_x` of {where} must be in (0, pi) radians, got {angle}. Correct the file.")
    return intrinsics(angle, width, height)


def _lens(values: dict[str, Any], where: str) -> Lens:
    """k1..k4 multiply r² to r⁸ as in nerfstudio's camera model (theta² to theta⁸ for fisheye)."""
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE + _FISHEYE:
        known = ", ".join((*_PERSPECTIVE, *_FISHEYE))
        raise InputError(f"`camera_model` of {where} is {model}; known are {known}. Undistort the images first.")

    def read(key: str) -> float:
        return files.number(values.get(key, 0.0), f"`{key}` of {where}")

    fisheye = model in _FISHEYE or values.get("is_fisheye") is True
    tangential = (0.0, 0.0) if fisheye else (read("p1"), read("p2"))
    return Lens(radial=(read("k1"), read("k2"), read("k3"), read("k4")), tangential=tangential, fisheye=fisheye)


def _pick_test(
    frames: list[PosedImage], document: dict[str, Any], root: Path
) -> tuple[list[PosedImage], list[PosedImage]]:
    """(test, input) by nerfstudio's `test_filenames`; what `val_filenames` names is neither."""

    def named(key: str) -> set[str]:
        names = document.get(key)
        found = names if isinstance(names, list) else []
        return {files.relative_name(files.child(root, name), root) for name in found if isinstance(name, str)}

    test = named("test_filenames")
    held_out = test | named("val_filenames")
    return [f for f in frames if f.name in test], [f for f in frames if f.name not in held_out]


def _points(document: dict[str, Any], root: Path, warnings: list[str]) -> tuple[Tensor | None, Tensor | None]:
    name = document.get("ply_file_path")
    if not isinstance(name, str):
        return None, None
    path = files.child(root, name)
    if not files.is_regular(path):
        warnings.append(
            f"The points {summarize_names([name])} (`ply_file_path`) are absent; the scene starts without them."
        )
        return None, None
    return read_points_ply(path)
