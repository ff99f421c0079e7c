"""Sparse points from a PLY file (nerfstudio's `ply_file_path`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from plyfile import PlyData, PlyParseError
from torch import Tensor

from gsopt.data import files
from gsopt.errors import InputError

_MAX_HEADER = 1 << 16


def read_points_ply(path: Path) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"]]:
    """Positions (float64) and colors (gray when the file has none); rows that are not finite are left out."""
    _check_counts(path)
    try:
        vertices = PlyData.read(str(path), mmap=False)["vertex"].data
        xyz = _columns(vertices, "xyz")
        colored = {"red", "green", "blue"} <= set(vertices.dtype.names or ())
        columns = _columns(vertices, ("red", "green", "blue")) if colored else None
    except (PlyParseError, KeyError, OSError, ValueError, TypeError, IndexError, MemoryError) as error:
        raise InputError(f"Cannot read the points {path}: {error}. Export them again, or remove the file.") from error
    rgb = np.full(xyz.shape, 128, dtype=np.uint8)
    kept = np.isfinite(xyz).all(axis=1)
    if columns is not None:
        scale = 1 if vertices["red"].dtype.kind in "iu" else 255
        kept &= np.isfinite(columns).all(axis=1)
        rgb[kept] = np.clip(columns[kept] * scale, 0, 255).astype(np.uint8)
    return torch.from_numpy(xyz[kept]), torch.from_numpy(rgb[kept])


def _columns(vertices: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """Properties side by side; ValueError or TypeError for one that is a list."""
    with np.errstate(invalid="ignore"):  # a signaling NaN warns of its conversion
        return np.stack([np.asarray(vertices[name], dtype=np.float64) for name in names], axis=1)


def _check_counts(path: Path) -> None:
    """InputError when the header promises more rows than the file has bytes, so that nothing huge is allocated."""
    remedy = "Export it again, or remove `ply_file_path`."
    if not files.is_regular(path):
        raise InputError(f"{path} is not a readable file. {remedy}")
    size = path.stat().st_size
    with open(path, "rb") as file:
        header, found, _ = file.read(_MAX_HEADER).partition(b"end_header")
    if not header.startswith(b"ply") or not found:
        raise InputError(f"{path} is not a PLY file (no header). {remedy}")
    for line in header.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and not (words[2].isdigit() and int(words[2]) <= size):
            got = words[2][:24].decode("ascii", "replace")
            raise InputError(f"{path} declares {got} rows but is only {size:,} bytes long. {remedy}")
