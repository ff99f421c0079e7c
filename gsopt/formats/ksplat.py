"""Reads mkkellogg's .ksplat: sections of splats, each in full floats or quantized in buckets around a center.

Layout: SplatBuffer.js of github.com/mkkellogg/GaussianSplats3D and read-ksplat.ts of
github.com/playcanvas/splat-transform. A header of 4096 bytes, a header of 1024 bytes per section, then per section: the
sizes of its partly filled buckets, the buckets' centers and the splats. Frame and meaning are those of a PLY, with
linear scales and 8-bit color and opacity.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsopt.errors import InputError
from gsopt.formats.files import opened, read_exactly
from gsopt.formats.placement import joined
from gsopt.formats.validation import BANDS, BYTE_OPACITY_MARGIN, log_scales, logit
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh

_HEADER, _SECTION = 4096, 1024
_LEVELS = ("<f4", "<f2", "<f2")
"""Type of scales and rotations by level of compression; positions are <u2 where these are <f2."""
_HARMONICS = ("<f4", "<f2", "u1")
_HALF_RANGE = 32767
_MAX_SECTIONS = 1 << 16


@dataclass(frozen=True)
class _Section:
    count: int
    capacity: int
    """Splats that the section has room for."""
    bucket_size: int
    buckets: int
    block: float
    """Side of a bucket, scene units."""
    bucket_bytes: int
    half_range: int
    full_buckets: int
    partial_buckets: int
    bands: int

    def row(self, level: int) -> np.dtype:
        """One splat."""
        return np.dtype(
            [
                ("mean", "<f4" if level == 0 else "<u2", 3),
                ("scale", _LEVELS[level], 3),
                ("quat", _LEVELS[level], 4),
                ("rgba", "u1", 4),
                ("rest", _HARMONICS[level], 3 * self.bands),
            ]
        )


def load_ksplat(path: Path) -> Gaussians:
    """Read a .ksplat of version 0.1, any level of compression; SH degree 0 to 3, the highest of its sections."""
    with opened(path) as (file, size):
        data = read_exactly(file, size, path, "its splats")
    if size < _HEADER or data[0] != 0 or data[1] < 1:
        raise InputError(f"{path} must begin as .ksplat 0.1, got {data[:2]!r} of {size} bytes. Check the path.")
    sections, level = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<H", data, 20)[0]
    if level > 2 or sections > _MAX_SECTIONS or _HEADER + sections * _SECTION > size:
        raise InputError(f"{path} claims {sections} sections at level {level} in {size} bytes. It is damaged.")
    low, high = struct.unpack_from("<ff", data, 36)
    span = (low or -1.5, high or 1.5)
    at = _HEADER + sections * _SECTION
    parts = []
    for number in range(sections):
        section = _section(data, number, path)
        part, at = _read_section(data, at, section, level, span, path)
        parts.append(part)
    filled = [part for part in parts if len(part)]
    if not filled:
        raise InputError(f"{path} holds no splats. Export it again.")
    parts.clear()
    return joined(filled)


def _section(data: bytes, number: int, path: Path) -> _Section:
    begin = _HEADER + number * _SECTION
    count, capacity, bucket_size, buckets, block, bucket_bytes = struct.unpack_from("<IIIIfH", data, begin)
    half_range, full, partial = struct.unpack_from("<I4xII", data, begin + 24)
    (degree,) = struct.unpack_from("<H", data, begin + 40)
    if degree >= len(BANDS) or count > capacity or not 0 <= block < 1e30:
        raise InputError(f"{path}: section {number} claims {count} of {capacity} splats, SH degree {degree}. Damaged.")
    half = half_range or _HALF_RANGE
    return _Section(count, capacity, bucket_size, buckets, block, bucket_bytes, half, full, partial, BANDS[degree])


def _read_section(
    data: bytes, at: int, section: _Section, level: int, span: tuple[float, float], path: Path
) -> tuple[Gaussians, int]:
    """The splats of the section that begins at byte `at`, and the byte after it."""
    row = section.row(level)
    centers_at = at + 4 * section.partial_buckets
    rows_at = centers_at + section.bucket_bytes * section.buckets
    end = rows_at + row.itemsize * section.capacity
    if end > len(data) or (level > 0 and section.buckets and section.bucket_bytes != 12):
        raise InputError(f"{path} ends {max(0, end - len(data))} bytes before its last splat. Copy or export it again.")
    rows = np.frombuffer(data, row, section.count, rows_at)
    means = rows["mean"].astype(np.float32)
    if level > 0:
        sizes = np.frombuffer(data, "<u4", section.partial_buckets, at)
        centers = np.frombuffer(data, "<f4", 3 * section.buckets, centers_at).reshape(-1, 3)
        bucket = _bucket_of_rows(section, sizes, path)
        with np.errstate(all="ignore"):  # the caller drops what is not finite
            means = (means - section.half_range) * (section.block / 2 / section.half_range) + centers[bucket]
    return _gaussians(rows, means.astype(np.float32), section.bands, level, span), end


def _bucket_of_rows(section: _Section, sizes: NDArray[np.uint32], path: Path) -> NDArray[np.int64]:
    """The bucket of each splat: full ones first, then the partly filled ones by their sizes."""
    full = min(section.full_buckets * section.bucket_size, section.count)
    ends = np.cumsum(sizes.astype(np.int64))
    rest = section.count - full
    if rest > (int(ends[-1]) if len(ends) else 0):
        raise InputError(f"{path}: its buckets hold fewer than its {section.count} splats. Export it again.")
    partly = section.full_buckets + np.searchsorted(ends, np.arange(rest), side="right")
    bucket = np.concatenate([np.arange(full) // max(1, section.bucket_size), partly])
    if len(bucket) and int(bucket.max()) >= section.buckets:
        raise InputError(f"{path}: a splat lies in bucket {bucket.max()} of {section.buckets}. Export it again.")
    return bucket


def _gaussians(
    rows: np.ndarray, means: NDArray[np.float32], bands: int, level: int, span: tuple[float, float]
) -> Gaussians:
    def floats(name: str) -> torch.Tensor:
        return torch.from_numpy(rows[name].astype(np.float32))

    rgba, rest = floats("rgba") / 255, floats("rest").reshape(len(rows), 3 * bands)
    if level == 2:
        rest = span[0] + rest / 255 * (span[1] - span[0])
    return Gaussians(
        means=torch.from_numpy(means),
        quats=floats("quat"),
        log_scales=log_scales(floats("scale")),
        logit_opacities=logit(rgba[:, 3], BYTE_OPACITY_MARGIN),
        sh0=sh.sh0_from_rgb(rgba[:, None, :3]),
        shN=_bands(rest, bands),
    )


def _bands(rest: torch.Tensor, bands: int) -> torch.Tensor:
    """[N, K-1, 3] from a file's order: band by band, and in each all of red, then green, then blue."""
    parts, begin = [], 0
    for width in (3, 5, 7)[: BANDS.index(bands)]:
        parts.append(rest[:, begin : begin + 3 * width].reshape(-1, 3, width).transpose(1, 2))
        begin += 3 * width
    return torch.cat(parts, dim=1).contiguous() if parts else rest.reshape(len(rest), 0, 3)
