"""DTU scenes as IDR and NeuS publish them (Yariv et al. 2020): cameras_sphere.npz, image/ and mask/.

`world_mat_i` projects the world to the pixels of the i-th image in name order (centers at whole numbers);
`scale_mat_i` takes the unit sphere, which holds the object, to that world. Positions are in the frame of the sphere, as
in IDR: lengths of the training loss are then of one size for all scenes.
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
from gsopt.data.numpy_files import read_matrices
from gsopt.data.posed_images import Dataset, PosedImage, check_pose, images_in_order
from gsopt.errors import InputError

CAMERAS = "cameras_sphere.npz"
SCALE_TOLERANCE = 1e-3
"""Largest relative difference between scale_mat_i and scale_mat_0: one object has one sphere."""


def read_idr(root: Path) -> Dataset:
    """Read cameras, images and masks of `root`. Raises InputError."""
    path = root / CAMERAS
    matrices = read_matrices(path)
    images = images_in_order(root / "image")
    masks = _masks(root, images)
    frames = []
    for position, image in enumerate(images):
        viewmat, K = _camera(matrices, position, path)
        width, height, _ = read_header(image)
        name = files.relative_name(image, root)
        frames.append(PosedImage(name, image, masks[position], viewmat, K, width, height, Lens(), position))
    return Dataset("idr", frames, None)


def _masks(root: Path, images: list[Path]) -> list[Path | None]:
    """Masks in name order: image/000000.png has mask/000.png."""
    folder = root / "mask"
    if not folder.is_dir():
        return [None] * len(images)
    masks = images_in_order(folder)
    if len(masks) != len(images):
        raise InputError(
            f"{folder} holds {len(masks)} masks for {len(images)} images. They belong together in name order: restore "
            "what is missing, or remove the folder."
        )
    return list(masks)


def _camera(
    matrices: dict[str, np.ndarray], position: int, path: Path
) -> tuple[Float[Tensor, "4 4"], Float[Tensor, "3 3"]]:
    """cam_from_world and K of image `position`."""
    names = f"world_mat_{position}", f"scale_mat_{position}"
    if absent := [name for name in names if name not in matrices]:
        raise InputError(f"{path} has no 4x4 matrix `{absent[0]}`. Restore the file, or remove images without camera.")
    world, scale = (matrices[name] for name in names)
    first = matrices.get("scale_mat_0", scale)
    if np.abs(scale - first).max() > SCALE_TOLERANCE * np.abs(first).max():
        raise InputError(
            f"{path}: `{names[1]}` differs from `scale_mat_0`. One object has one sphere: export it again."
        )
    R, t, K = split_projection((world @ scale)[:3], f"`{names[0]}` in {path}")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, t
    check_pose(torch.from_numpy(viewmat), f"`{names[0]}` in {path}")
    K[:2, 2] += 0.5  # gsopt's pixel centers are at +0.5
    return torch.from_numpy(viewmat), torch.from_numpy(K)


def split_projection(
    P: Float[np.ndarray, "3 4"], where: str
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """R, t and K of a projection matrix P ~ K [R | t] (Hartley & Zisserman 2004, 6.2.4), skew dropped."""
    M = P[:, :3]
    if not abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3:
        raise InputError(f"The projection {where} is singular: it is no camera. Correct or remove it.")
    if np.linalg.det(M) < 0:
        P = -P
        M = P[:, :3]
    flip = np.eye(3)[::-1]
    Q, U = np.linalg.qr((flip @ M).T)  # M = K R with K upper triangular, by QR from below
    K, R = flip @ U.T @ flip, flip @ Q.T
    signs = np.sign(np.diag(K))
    K, R = K * signs, signs[:, None] * R
    t = np.linalg.solve(K, P[:, 3])
    K = K / K[2, 2]
    K[0, 1] = 0.0
    return R, t, K
