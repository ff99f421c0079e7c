"""Blender's multilayer OpenEXR, uncompressed: every pass of a render in one file, read without Blender or OpenEXR.

Layout from "OpenEXR File Layout" (openexr.com): magic, version, attributes, offset table, then one chunk per row.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsopt.errors import GsoptError

if TYPE_CHECKING:
    from jaxtyping import Float32

MAGIC = 20000630
DTYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
PASS_OF = {"Combined": "color", "Depth": "depth", "Normal": "normals", "Position": "position"}


def read_passes(path: Path) -> dict[str, Float32[np.ndarray, "H W C"]]:
    """Passes by our names (`PASS_OF`), channels in the order RGBA or XYZ. GsoptError for any other kind of EXR."""
    found: dict[str, dict[str, Float32[np.ndarray, "H W"]]] = {}
    for name, plane in read_channels(path).items():
        _, _, tail = name.partition(".")  # the view layer's name
        kind, _, axis = tail.partition(".")
        if kind in PASS_OF:
            found.setdefault(PASS_OF[kind], {})[axis] = plane
    return {kind: np.stack([planes[a] for a in "RGBAXYZV" if a in planes], axis=2) for kind, planes in found.items()}


def read_channels(path: Path) -> dict[str, Float32[np.ndarray, "H W"]]:
    """Channels by their full names, rows from top to bottom."""
    data = path.read_bytes()
    magic, version = struct.unpack_from("<ii", data)
    attributes, at = read_attributes(data, 8)
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if magic != MAGIC or version & 0x1A00 or attributes["compression"] != b"\0":  # tiled, deep or of many parts
        raise GsoptError(f"{path.name} is not the uncompressed scanline EXR asked for. Report this Blender version.")
    row = np.dtype([("y", "<i4"), ("size", "<i4"), *channel_fields(attributes["channels"], width)])
    rows = np.frombuffer(data, row, count=height, offset=at + 8 * height)
    rows = rows[np.argsort(rows["y"])]
    return {name: rows[name].astype(np.float32) for name in rows.dtype.names or () if name not in ("y", "size")}


def read_attributes(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    """Header attributes by name, and where the header ends."""
    attributes = {}
    while data[at]:
        name_end = data.index(b"\0", at)
        start = data.index(b"\0", name_end + 1) + 5  # after the type's name and the size
        (size,) = struct.unpack_from("<i", data, start - 4)
        attributes[data[at:name_end].decode()] = data[start : start + size]
        at = start + size
    return attributes, at + 1


def channel_fields(channels: bytes, width: int) -> list[tuple[str, np.dtype, tuple[int]]]:
    """One numpy field per channel: a row holds all of the first channel, then all of the second, ..."""
    fields, at = [], 0
    while channels[at]:
        end = channels.index(b"\0", at)
        (kind,) = struct.unpack_from("<i", channels, end + 1)
        fields.append((channels[at:end].decode(), DTYPES[kind], (width,)))
        at = end + 17  # type, linearity, 3 bytes reserved, sampling in x and y
    return fields
