"""Arrays in .npy and .npz files, checked by their headers before memory is taken; never unpickled."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np

from gsopt.data import files
from gsopt.errors import InputError

MAX_MATRIX_BYTES = 4096
"""Size of an archived 4x4 matrix, at most: 128 bytes of doubles and a header."""
MAX_MEMBERS = 100_000
"""Most arrays in an archive."""
_REMEDY = "Export the dataset again, or restore the file."


def read_table(path: Path, columns: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The finite numbers of a .npy file with so many columns. InputError for anything else."""
    if not files.is_regular(path):
        raise InputError(f"{path} is not a readable file. {_REMEDY}")
    try:
        # A map takes no memory, and refuses a header that promises more than the file holds.
        table = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a hostile header raises nearly anything
        raise InputError(f"{path} is no array that NumPy reads safely: {error}. {_REMEDY}") from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] != columns or table.dtype.kind != "f":
        got = f"{getattr(table, 'dtype', 'no array')} {list(getattr(table, 'shape', []))}"
        raise InputError(f"{path} must hold floats of shape [N, {columns}], got {got}. {_REMEDY}")
    values = np.array(table, dtype=np.float64)
    broken = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(broken):
        raise InputError(f"{path} is not finite in row {broken[0]} (NaN or infinity). Correct or remove that row.")
    return values


def read_matrices(path: Path) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
    """The finite 4x4 matrices in a .npz file by name; arrays of other shapes are skipped. InputError when broken."""
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(_matrices(archive))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # zip and header parsers raise nearly anything on a hostile file
        raise InputError(f"{path} is no archive of arrays that NumPy reads safely: {error}. {_REMEDY}") from error


def _matrices(archive: zipfile.ZipFile) -> Iterator[tuple[str, np.ndarray[Any, np.dtype[np.float64]]]]:
    members = archive.infolist()
    if len(members) > MAX_MEMBERS:
        raise InputError(f"{len(members):,} arrays, more than the {MAX_MEMBERS:,} read at most. {_REMEDY}")
    for member in members:
        if not member.filename.endswith(".npy") or member.file_size > MAX_MATRIX_BYTES:
            continue
        name = member.filename.removesuffix(".npy")
        with archive.open(member) as file:
            matrix = _matrix(file)
        if matrix is None:
            continue
        if not np.isfinite(matrix).all():
            raise InputError(f"`{name}` is not finite (NaN or infinity). Correct or remove that camera.")
        yield name, matrix


def _matrix(file: IO[bytes]) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """The 4x4 matrix of floats in an open .npy file, or None for another array."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read_header(file)
    if shape != (4, 4) or dtype.kind != "f":
        return None
    data = file.read(16 * dtype.itemsize)
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").astype(np.float64)
