"""Niantic's .spz, versions 2 and 3, unpacked with zlib and numpy. Layout: github.com/nianticlabs/spz.

Header: magic NGSP, version, count (uint32 each), SH degree, fractional bits, flags, 0; then positions (24 bit), alphas,
colors, scales, rotations and harmonics, one gzip stream over all. Its frame is right, up, back; ours, as in a PLY of
the field, right, down, forward.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .splats import Floats, Splats, from_file_values, turned

HEADER = struct.Struct("<4sIIBBBB")
RIGHT_UP_BACK = (1, -1, -1)
PIECE = 1 << 20
ALWAYS = 1 << 26
"""Bytes that may always be unpacked."""
RATIO = 50
"""Beyond that a file may unpack to this many times its size; real splats reach about 5."""
ANTIALIASED = 0x1
HALF = math.sqrt(0.5)

Progress = Callable[[float], None]


def read_spz(path: Path, progress: Progress = lambda share: None) -> Splats:
    """The splats of a file. InputError for damage, extensions, a hostile size or version 4."""
    try:
        with open(path, "rb") as file:
            if file.read(4) == b"NGSP":
                raise InputError(
                    f"{path} is a .spz of version 4, versions 2 and 3 are read here. Convert it with `gsopt export`."
                )
            file.seek(0)
            return Unpacker(file, path, progress).splats()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}. Choose another file.") from error


class Unpacker:
    """A gzip stream taken apart, never more bytes at a time than asked for."""

    def __init__(self, file: BinaryIO, path: Path, progress: Progress) -> None:
        self.file, self.path, self.progress = file, path, progress
        self.size = os.fstat(file.fileno()).st_size
        self.zlib = zlib.decompressobj(16 + zlib.MAX_WBITS)

    def take(self, count: int) -> NDArray[np.uint8]:
        out = bytearray()
        while len(out) < count:
            data = self.zlib.unconsumed_tail or self.file.read(PIECE)
            if not data or self.zlib.eof:
                raise InputError(f"{self.path} ends before its last splat. Copy or export it again.")
            try:
                out += self.zlib.decompress(data, count - len(out))
            except zlib.error as error:
                raise InputError(f"{self.path} is damaged: {error}. Copy or export it again.") from error
            self.progress(min(1.0, self.file.tell() / max(1, self.size)))
        return np.frombuffer(bytes(out), np.uint8)

    def splats(self) -> Splats:
        magic, version, count, degree, fraction, flags, _ = HEADER.unpack(self.take(HEADER.size).tobytes())
        if magic != b"NGSP" or version not in (2, 3):
            raise InputError(f"{self.path} is no .spz of version 2 or 3, got {magic!r} {version}. Check the path.")
        if degree > 3 or fraction > 23 or flags & ~ANTIALIASED:
            raise InputError(
                f"{self.path} has SH degree {degree}, {fraction} fraction bits, flags {flags:#x}: not known here. "
                "Export it again without extensions."
            )
        bands = (degree + 1) ** 2 - 1
        sizes = (9, 1, 3, 3, 3 if version == 2 else 4, 3 * bands)
        total = count * sum(sizes)
        if total > max(ALWAYS, RATIO * self.size):
            raise InputError(f"{self.path} claims {count:,} splats in {self.size:,} bytes. It is damaged or hostile.")
        points, alphas, colors, scales, rotations, rest = (self.take(count * size) for size in sizes)
        with np.errstate(divide="ignore"):
            p = np.clip(alphas / np.float32(255), 0.25 / 255, 1 - 0.25 / 255)
        found = from_file_values(
            fixed_point(points.reshape(count, 3, 3), fraction),
            scales.reshape(count, 3).astype(np.float32) / np.float32(16) - np.float32(10),
            first_three(rotations) if version == 2 else smallest_three(rotations),
            np.log(p / (1 - p)).astype(np.float32),
            ((colors.astype(np.float32) / np.float32(255) - np.float32(0.5)) / np.float32(0.15)).reshape(count, 3),
            ((rest.astype(np.float32) - np.float32(128)) / np.float32(128)).reshape(count, bands, 3),
            self.path,
        )
        return turned(found, RIGHT_UP_BACK)


def fixed_point(codes: NDArray[np.uint8], fraction: int) -> Floats:
    """24-bit signed numbers: put into the upper three bytes, so that shifting down repeats the sign."""
    wide = np.zeros((len(codes), 3, 4), np.uint8)
    wide[:, :, 1:] = codes
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float32) / np.float32(1 << fraction)


def first_three(codes: NDArray[np.uint8]) -> Floats:
    """Version 2: x, y, z as bytes; w follows from the length."""
    xyz = codes.reshape(-1, 3).astype(np.float32) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))
    return np.concatenate([w[:, None], xyz], axis=1)


def smallest_three(codes: NDArray[np.uint8]) -> Floats:
    """Version 3: two bits name the largest of x y z w, the others have a sign and nine bits each."""
    code = codes.view("<u4").astype(np.uint32)
    largest = code >> 30
    xyzw = np.zeros((len(code), 4), np.float32)
    for i in (3, 2, 1, 0):
        value = (code & 511).astype(np.float32) * np.float32(HALF / 511)
        xyzw[:, i] = np.where(largest == i, 0, np.where(code >> 9 & 1, -value, value))
        code = np.where(largest == i, code, code >> 10)
    rest = np.sqrt(np.maximum(0, 1 - np.square(xyzw).sum(axis=1)))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]])
