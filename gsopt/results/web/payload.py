"""Splats as the bytes of a page: the codes of .spz in planes, which deflate to less than a .spz.

Splats are neighbors (Morton order), positions are differences to the splat before. worker.js reads the planes in the
order in which `planes` yields them.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsopt.formats.spz_codes import pack
from gsopt.formats.validation import storable
from gsopt.gaussians import Gaussians
from gsopt.geometry.morton import morton_order

Bytes = NDArray[np.uint8]
LEVEL = 7
"""Deflate at level 9 takes six times as long for 0.7 % fewer bytes of a million splats."""


@dataclass(frozen=True)
class Payload:
    """The splats of a page."""

    data: bytes
    """A zlib stream."""
    count: int
    sh_degree: int
    fraction_bits: int
    """Positions are whole numbers times 2^-fraction_bits scene units."""

    @property
    def color_stride(self) -> int:
        """Texels per splat: base color and opacity, then one coefficient of the harmonics each."""
        return (self.sh_degree + 1) ** 2


def packed_splats(gaussians: Gaussians, path: Path) -> Payload:
    """The splats in the frame of a PLY. Raises InputError for what a .spz cannot hold; `path` names it."""
    gaussians = storable(gaussians, path)
    gaussians = gaussians.select(morton_order(gaussians.means.double().flip(-1)))
    fraction_bits, streams = pack(gaussians, path)
    packer = zlib.compressobj(LEVEL)
    data = b"".join(packer.compress(plane.tobytes()) for plane in planes(streams, len(gaussians)))
    return Payload(data + packer.flush(), len(gaussians), gaussians.sh_degree, fraction_bits)


def planes(streams: list[bytes], count: int) -> Iterator[Bytes]:
    """One byte of every splat after the other."""
    positions, alphas, colors, scales, quats, bands = (np.frombuffer(stream, np.uint8) for stream in streams)
    for axis in positions.reshape(count, 3, 3).transpose(1, 0, 2):
        codes = axis.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
        yield from _byte_planes(np.diff(codes, prepend=0), 3)
    yield from scales.reshape(count, 3).T
    yield from quats.reshape(count, 4).T
    yield from colors.reshape(count, 3).T
    yield alphas
    yield from bands.reshape(count, -1).T


def _byte_planes(values: NDArray[np.int64], count: int) -> Iterator[Bytes]:
    """The lowest bytes, the next ones, ..."""
    for i in range(count):
        yield (values >> (8 * i) & 255).astype(np.uint8)
