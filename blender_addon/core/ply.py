"""The Inria PLY, read and written with numpy alone; headers are not believed.

One element `vertex`: x y z, f_dc_0..2, f_rest_* (all of red, then green, then blue), opacity (logit), scale_*
(logarithm), rot_0..3 (w x y z), and anything else, which is left out. Layout: Kerbl et al. 2023.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .files import replacing
from .splats import BANDS, Splats, from_file_values, log_scales, logits

MAX_HEADER = 1 << 16
BLOCK = 1 << 16
"""Rows that are read or written at a time."""
TYPES = {
    name: code
    for code, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
NEEDED = (
    ("x", "y", "z"),
    ("scale_0", "scale_1", "scale_2"),
    ("rot_0", "rot_1", "rot_2", "rot_3"),
    ("opacity",),
    ("f_dc_0", "f_dc_1", "f_dc_2"),
)
COUNT = re.compile(r"[0-9]{1,18}")

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Element:
    """Header of one element."""

    name: str
    count: int
    row: np.dtype


def read_ply(path: Path, progress: Progress = lambda share: None) -> Splats:
    """The splats of a file. InputError for a file that lies about its size, is cut short or holds no splats."""
    try:
        with open(path, "rb") as file:
            elements = read_header(file, path)
            vertex = seek_vertex(file, elements, path)
            return read_vertices(file, vertex, path, progress)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}. Choose another file.") from error


def read_header(file: BinaryIO, path: Path) -> list[Element]:
    """The elements in file order; the position is left at the first row."""
    head = file.read(MAX_HEADER)
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{path} is no PLY file: it begins with {head[:12]!r}. Choose a file of splats.")
    file.seek(end.end())
    lines = head[: end.start()].decode("latin-1").splitlines()[1:]
    order = next((ORDERS.get(line.split()[1]) for line in lines if re.match(r"format \S+ 1\.0", line)), None)
    if order is None:
        raise InputError(f"{path} is not a binary PLY. Export it as binary, for instance with `gsopt export`.")
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    for line in lines:
        match line.split():
            case ["element", name, count] if COUNT.fullmatch(count):
                found.append((name, int(count), []))
            case ["property", kind, name] if found and kind in TYPES and name not in dict(found[-1][2]):
                found[-1][2].append((name, order + TYPES[kind]))
            case [] | ["comment" | "obj_info" | "format", *_]:
                continue
            case _:
                raise InputError(f"{path}: this line of its header makes no sense: {line[:60]!r}. Export it again.")
    return [Element(name, count, np.dtype(columns)) for name, count, columns in found]


def seek_vertex(file: BinaryIO, elements: list[Element], path: Path) -> Element:
    """The element `vertex`, with the position at its first row, after the claimed size was compared with the file's."""
    size = os.fstat(file.fileno()).st_size
    for element in elements:
        need, have = element.count * element.row.itemsize, size - file.tell()
        if need > have:
            raise InputError(
                f"{path} claims {element.count:,} rows of `{element.name:.40}`, {need:,} bytes, "
                f"but has {max(have, 0):,}. It was cut short or is damaged: copy or export it again."
            )
        if element.name == "vertex":
            return element
        file.seek(need, os.SEEK_CUR)
    raise InputError(f"{path} has no element `vertex`. Choose a file of splats.")


def bands_of(vertex: Element, path: Path) -> int:
    """K - 1 of an element that has all a splat needs."""
    names = set(vertex.row.names or ())
    missing = [name for group in NEEDED for name in group if name not in names]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}. It is a mesh or a point cloud: choose a file of splats.")
    rest = {name for name in names if name.startswith("f_rest_")}
    if len(rest) // 3 not in BANDS or rest != {f"f_rest_{i}" for i in range(3 * (len(rest) // 3))}:
        raise InputError(f"{path} has {len(rest)} f_rest_*, 0, 9, 24 or 45 are known. Export it with SH degree 0 to 3.")
    return len(rest) // 3


def read_vertices(file: BinaryIO, vertex: Element, path: Path, progress: Progress) -> Splats:
    """All rows, block by block: no more memory than the result and a block."""
    bands = bands_of(vertex, path)
    groups = [*NEEDED, tuple(f"f_rest_{i}" for i in range(3 * bands))]
    parts = [np.empty((vertex.count, len(names)), np.float32) for names in groups]
    for start in range(0, vertex.count, BLOCK):
        rows = min(BLOCK, vertex.count - start)
        data = file.read(rows * vertex.row.itemsize)
        if len(data) < rows * vertex.row.itemsize:
            raise InputError(f"{path} shrank while it was read. Wait until nobody writes to it, then try again.")
        block = np.frombuffer(data, vertex.row)
        for names, part in zip(groups, parts, strict=True):
            copy_columns(block, names, part[start : start + rows])
        progress((start + rows) / vertex.count)
    positions, scales, rotations, opacities, base, rest = parts
    sh = np.ascontiguousarray(rest.reshape(vertex.count, 3, bands).transpose(0, 2, 1))
    return from_file_values(positions, scales, rotations, opacities[:, 0], base, sh, path)


def copy_columns(block: NDArray[np.void], names: tuple[str, ...], out: NDArray[np.float32]) -> None:
    """Columns of a structured block into a matrix; a file of float32 alone is copied as one slice."""
    row = block.dtype
    places = [(row.names or ()).index(name) for name in names]
    plain = all(row[i] == row[0] and row[i].itemsize == 4 and row[i].kind == "f" for i in range(len(row.names or ())))
    if plain and places and places == list(range(places[0], places[0] + len(places))):
        out[...] = block.view(row[0]).reshape(len(block), -1)[:, places[0] : places[0] + len(places)]
        return
    with np.errstate(over="ignore"):
        for i, name in enumerate(names):
            out[:, i] = block[name]


def write_ply(path: Path, splats: Splats, comment: str = "", progress: Progress = lambda share: None) -> None:
    """Binary little endian float32, which every splat tool reads; a whole file or the one that was there before."""
    bands = splats.sh.shape[1]
    rest = [f"f_rest_{i}" for i in range(3 * bands)]
    names = [*"xyz", "nx", "ny", "nz", *NEEDED[4], *rest, "opacity", *NEEDED[1], *NEEDED[2]]
    lines = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    lines += [f"element vertex {len(splats)}", *(f"property float {name}" for name in names), "end_header", ""]
    with replacing(path) as file:
        file.write("\n".join(lines).encode("ascii", "replace"))
        for start in range(0, len(splats), BLOCK):
            part = splats.rows(slice(start, start + BLOCK))
            block = np.zeros((len(part), len(names)), "<f4")
            block[:, 0:3] = part.positions
            block[:, 6:9] = part.base
            block[:, 9:-8] = part.sh.transpose(0, 2, 1).reshape(len(part), 3 * bands)
            block[:, -8] = logits(part)
            block[:, -7:-4] = log_scales(part)
            block[:, -4:] = part.rotations
            file.write(block.data)
            progress((start + len(part)) / len(splats))
