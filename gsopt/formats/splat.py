"""antimatter15's .splat: 32 bytes per splat, no header, no view-dependent color.

Three float32 for the center, three for the (linear) standard deviations, RGBA as bytes, and the quaternion w x y z as
bytes round(128 q) + 128. Layout: the `convert.py` of github.com/antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsopt.errors import InputError
from gsopt.formats.files import opened, read_exactly, replacing
from gsopt.formats.validation import BYTE_OPACITY_MARGIN, log_scales, logit, opacity_bytes, scales, storable, to_bytes
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.quats import normalize

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_BLOCK = 1 << 16


def save_splat(path: Path, gaussians: Gaussians) -> None:
    """Write a .splat, keeping the order of the rows; bands 1 and up of the spherical harmonics are dropped.

    Reading back differs by at most: means 0; log-scales 1e-5 within ±87 (a float32's range); opacity 1/255;
    color 0.5/255 where it lies in [0, 1], else clamped; each component of the unit quaternion 1/128.
    """
    gaussians = storable(gaussians, path)
    with replacing(path) as file:
        for start in range(0, len(gaussians), _BLOCK):
            file.write(_pack(gaussians.select(torch.arange(start, min(start + _BLOCK, len(gaussians))))).tobytes())


def _pack(gaussians: Gaussians) -> np.ndarray:
    rows = np.empty(len(gaussians), _ROW)
    rows["mean"] = gaussians.means.numpy()
    rows["scale"] = scales(gaussians.log_scales).numpy()
    rows["rgba"][:, :3] = to_bytes(sh.rgb_from_sh0(gaussians.sh0[:, 0]) * 255).numpy()
    rows["rgba"][:, 3] = opacity_bytes(gaussians.opacities).numpy()
    rows["quat"] = to_bytes(normalize(gaussians.quats.double()) * 128 + 128).numpy()
    return rows


def load_splat(path: Path) -> Gaussians:
    """Read a .splat as Gaussians of SH degree 0. A scale of 0, which flat splats have, becomes the least float32."""
    with opened(path) as (file, size):
        if size % _ROW.itemsize:
            raise InputError(
                f"{path} must hold {_ROW.itemsize} bytes per splat, got {size} bytes, which is no multiple. "
                "The file was cut short or is no .splat: copy or export it again."
            )
        data = read_exactly(file, size, path, "its splats")
    return _unpack(np.frombuffer(data, _ROW))


def _unpack(rows: np.ndarray) -> Gaussians:
    rgba = torch.from_numpy(rows["rgba"].astype(np.float32)) / 255
    return Gaussians(
        means=torch.from_numpy(rows["mean"].astype(np.float32)),
        quats=(torch.from_numpy(rows["quat"].astype(np.float32)) - 128) / 128,
        log_scales=log_scales(torch.from_numpy(rows["scale"].astype(np.float32))),
        logit_opacities=logit(rgba[:, 3], BYTE_OPACITY_MARGIN),
        sh0=sh.sh0_from_rgb(rgba[:, None, :3]),
        shN=torch.empty(len(rows), 0, 3),
    )
