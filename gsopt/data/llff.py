"""LLFF folders: poses_bounds.npy and images/, as Mildenhall et al. 2019 ("Local Light Field Fusion") write them.

Row i of the file belongs to the i-th image in name order: 15 numbers of a 3x5 matrix, then the nearest and farthest
depth, which gsopt does not use. The first four columns are world_from_cam with the axes down, right, backward; the
fifth is height, width and focal length, in pixels of the images that were posed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.data.images import read_header
from gsopt.data.lens import Lens
from gsopt.data.numpy_files import read_table
from gsopt.data.posed_images import Dataset, PosedImage, check_pose, images_in_order
from gsopt.errors import InputError
from gsopt.geometry.cameras import viewmats_from_opengl

POSES = "poses_bounds.npy"
COLUMNS = 17
MAX_STRETCH = 0.01
"""Largest relative difference between the scales of width and height: copies of another size are rounded."""


def read_llff(root: Path) -> Dataset:
    """Read the poses and images of `root`. Raises InputError."""
    path = root / POSES
    table = read_table(path, COLUMNS)
    images = images_in_order(root / "images")
    if len(images) != len(table):
        raise InputError(
            f"{path} poses {len(table)} images, but {root / 'images'} holds {len(images)}. Rows and images belong "
            "together in name order: restore the images, or remove what is none of them."
        )
    frames = [
        _frame(root, image, row, position) for position, (image, row) in enumerate(zip(images, table, strict=True))
    ]
    return Dataset("llff", frames, None)


def _frame(root: Path, image: Path, row: Float[np.ndarray, "17"], position: int) -> PosedImage:
    matrix = torch.from_numpy(row[:15].reshape(3, 5))
    where = f"image {image.name!r} in {root / POSES}"
    height, width, focal = matrix[:, 4].tolist()
    if min(height, width, focal) <= 0:
        raise InputError(
            f"Height, width and focal length of {where} must be positive, got {height}, {width}, {focal}. Correct it."
        )
    viewmat = viewmats_from_opengl(_world_from_cam(matrix, where))
    stored = read_header(image)[:2]
    K = _intrinsics(focal, (width, height), stored, where)
    return PosedImage(files.relative_name(image, root), image, None, viewmat, K, *stored, Lens(), position)


def _world_from_cam(matrix: Float[Tensor, "3 5"], where: str) -> Float[Tensor, "4 4"]:
    """The pose in OpenGL axes (right, up, backward)."""
    down, right, backward, center = matrix[:, :4].unbind(1)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack([right, -down, backward, center], dim=1)
    check_pose(pose, where)
    return pose


def _intrinsics(focal: float, posed: tuple[float, float], stored: tuple[int, int], where: str) -> Float[Tensor, "3 3"]:
    """Focal lengths at the size of the stored image; the principal point is in its middle."""
    across, down = stored[0] / posed[0], stored[1] / posed[1]
    if abs(across / down - 1) > MAX_STRETCH:
        raise InputError(
            f"The {where} was posed at {posed[0]:g}x{posed[1]:g} pixels, but the file is {stored[0]}x{stored[1]}: "
            "another aspect. Restore the original image."
        )
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = focal * across, focal * down, stored[0] / 2, stored[1] / 2
    return K
