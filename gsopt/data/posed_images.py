"""Posed images as a dataset's files give them, in float64, before `load_scene` chooses or moves any."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.data import files
from gsopt.data.lens import Lens
from gsopt.errors import InputError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
MAX_NAME = 255
"""Characters of a name in a warning."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of |RᵀR - I|: files written with four digits pass, a scaled or sheared camera does not."""


@dataclass(frozen=True)
class PosedImage:
    """One posed image file."""

    name: str
    path: Path
    mask: Path | None
    viewmat: Float[Tensor, "4 4"]
    """cam_from_world, OpenCV axes, float64."""
    K: Float[Tensor, "3 3"]
    """Pixels of the full-size stored image, before undistortion, float64."""
    width: int
    height: int
    lens: Lens
    position: int
    """Its number in `--view-ids`: its row in the file (NeRF-synthetic), else its row in name order."""


@dataclass(frozen=True)
class Dataset:
    """A dataset as read."""

    kind: str
    frames: list[PosedImage]
    """In the order that `--view-ids` counts."""
    held_out: list[PosedImage] | None
    """Frames the dataset itself holds out, if it has a split."""
    xyz: Float[Tensor, "P 3"] | None = None
    rgb: UInt8[Tensor, "P 3"] | None = None
    warnings: list[str] = field(default_factory=list)


def check_pose(matrix: Float[Tensor, "4 4"], where: str) -> None:
    """InputError naming `where` unless the matrix is finite and rigid (a rotation and a translation)."""
    remedy = "Correct or remove that frame."
    if not bool(torch.isfinite(matrix).all()):
        raise InputError(f"The pose of {where} is not finite (NaN or infinity in its matrix). {remedy}")
    R = matrix[:3, :3]
    deviation = float((R.T @ R - torch.eye(3).to(R)).abs().max())
    if not deviation < RIGID_TOLERANCE or float(torch.linalg.det(R)) < 0:
        what = "mirrored" if deviation < RIGID_TOLERANCE else f"not a rotation (off by {deviation:.3g})"
        raise InputError(
            f"The pose of {where} is not rigid: its 3x3 part is {what}. {remedy} Apply any camera scale first."
        )
    bottom = matrix[3].tolist()
    if max(abs(a - b) for a, b in zip(bottom, (0, 0, 0, 1), strict=True)) > RIGID_TOLERANCE:
        raise InputError(f"The pose of {where} is not rigid: its last row is {bottom}, not 0 0 0 1. {remedy}")


def read_pose(record: dict[str, Any], key: str, where: str) -> Float[Tensor, "4 4"]:
    """The matrix of 3 or 4 rows under a JSON record's `key`, checked to be finite and rigid; float64."""
    matrix = record.get(key)
    rows = matrix if isinstance(matrix, list) else []
    if len(rows) not in (3, 4) or any(not isinstance(row, list) or len(row) != 4 for row in rows):
        raise InputError(f"`{key}` of {where} must be 4 rows of 4 numbers. Correct or remove that frame.")
    try:
        values = [[float(value) for value in row] for row in rows]
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"`{key}` of {where} must hold numbers: {error}. Correct that frame.") from error
    pose = torch.tensor([*values, [0.0, 0.0, 0.0, 1.0]][:4], dtype=torch.float64)
    check_pose(pose, where)
    return pose


def images_in_order(folder: Path) -> list[Path]:
    """The image files of a folder in name order, for datasets that pair them with cameras by position. InputError
    without any."""
    found = sorted(folder.iterdir(), key=lambda path: path.name) if folder.is_dir() else []
    images = [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and files.is_regular(path)]
    if not images:
        raise InputError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)}). Put the dataset's images there.")
    return images


def check_enough(frames: list[PosedImage], absent: list[str], path: Path) -> None:
    """InputError when the absent images leave fewer than two of those that `path` names."""
    if absent and len(frames) < 2:
        raise InputError(
            f"Only {len(frames)} of the {len(frames) + len(absent)} images that {path} names exist; absent are "
            f"{summarize_names(absent)}. Put them where the file says, or correct the file."
        )


def summarize_names(names: list[str], most: int = 5) -> str:
    """The first few names, shortened, and how many more there are, for a warning of one line."""
    rest = len(names) - most
    short = (name if len(name) <= MAX_NAME else f"{name[:MAX_NAME]}..." for name in names[:most])
    return ", ".join(short) + (f" and {rest} more" if rest > 0 else "")
