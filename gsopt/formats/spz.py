"""Niantic's .spz: each attribute of all splats in a row, quantized to bytes and compressed as one gzip stream (2, 3) or
as one Zstandard stream per attribute (4).

Layout and quantization: README and src/cc/load-spz.cc of github.com/nianticlabs/spz. Header: magic NGSP, version,
number of splats (uint32 each), SH degree, fractional bits, flags, and one byte that is 0 (2, 3) or the number of
streams (4). Version 4 goes on with the offset of its table (uint32) and 12 zero bytes; the table holds a compressed and
a plain size (uint64 each) per stream. The frame is right, up, back unless an extension names another.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import torch

from gsopt.errors import InputError, InputWarning
from gsopt.formats.axes import RIGHT_UP_BACK, with_flipped_axes
from gsopt.formats.compression import GzipStream, check_budget, deflated, needs_check, unzstd, zstandard_compressed
from gsopt.formats.files import opened, read_exactly, replacing
from gsopt.formats.placement import placed
from gsopt.formats.spz_codes import pack, stream_sizes, unpack
from gsopt.formats.spz_extensions import RIGHT_UP_BACK as OWN_FRAME
from gsopt.formats.spz_extensions import frame_of, ply_from_frame
from gsopt.formats.validation import MAX_SH_DEGREE, storable
from gsopt.gaussians import Gaussians

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_TABLE_OFFSET = struct.Struct("<I12x")
_SIZES = struct.Struct("<QQ")
_ANTIALIASED, _HAS_EXTENSIONS = 0x1, 0x2
_MAX_EXTENSIONS = 1 << 20
"""Bytes of all extension records; known ones have 12."""
_MAX_FILE_DEGREE = 4
_MAX_SPLATS = 1 << 28
_MAX_FRACTION = 23


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    sh_degree: int
    fraction_bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of each attribute, in file order."""
        return stream_sizes(self.count, self.sh_degree, self.version)

    @property
    def decoded(self) -> int:
        """Bytes of the float32 parameters."""
        return 4 * self.count * (11 + 3 * (self.sh_degree + 1) ** 2)


def save_spz(path: Path, gaussians: Gaussians, *, antialiased: bool = False, version: int = 3) -> None:
    """Write a .spz of version 3, which every reader knows, or 4, which needs the package `zstandard`.

    Reading back differs by at most: means half of 2^-b scene units, b = 16 where every |coordinate| < 128 and less for
    larger scenes (12 at 2048, 0 at 2^23, beyond which InputError); log-scales 1/32 in [-10, 5.9]; opacity 1/255;
    sh0 0.0131 in ±3.3; band 1 0.036 and bands 2, 3 0.067 in ±0.9, clamped outside; each component of the unit
    quaternion, up to its sign, 0.0022. The order of the rows is kept.
    """
    if version not in (3, 4):
        raise InputError(f"{path}: .spz version must be 3 or 4, got {version}. Leave it out for 3.")
    gaussians = with_flipped_axes(storable(gaussians, path), RIGHT_UP_BACK)
    fraction_bits, streams = pack(gaussians, path)
    flags = _ANTIALIASED if antialiased else 0
    streams = [stream for stream in streams if stream]
    last = len(streams) if version == 4 else 0
    header = _HEADER.pack(_MAGIC, version, len(gaussians), gaussians.sh_degree, fraction_bits, flags, last)
    with replacing(path) as file:
        if version == 3:
            file.writelines(deflated([header, *streams]))
            return
        packed = [zstandard_compressed(stream) for stream in streams]
        file.write(header + _TABLE_OFFSET.pack(_HEADER.size + _TABLE_OFFSET.size))
        file.writelines(_SIZES.pack(len(small), len(plain)) for small, plain in zip(packed, streams, strict=True))
        file.writelines(packed)


def load_spz(path: Path) -> Gaussians:
    """Read a .spz of version 2, 3 or (with the package `zstandard`) 4.

    Band 4 of the harmonics is left out with a warning. A file that would decode to far more than its own size is
    refused before it is unpacked. One that unpacks to much more is first read to its end, where a checksum tells
    whether it is damaged, without keeping what was unpacked.
    """
    with opened(path) as (file, size):
        read = _read_gzip if _is_gzip(file, path) else _read_zstandard
        header, streams, extensions = read(file, size, path)
    frame = frame_of(extensions, path)
    gaussians = unpack(streams, header.count, header.sh_degree, header.version, header.fraction_bits)
    if header.sh_degree > MAX_SH_DEGREE:
        warnings.warn(f"{path}: band 4 of its harmonics was left out, 3 are drawn.", InputWarning, stacklevel=4)
        gaussians = gaussians.with_sh_degree(MAX_SH_DEGREE)
    if frame == OWN_FRAME:
        return with_flipped_axes(gaussians, RIGHT_UP_BACK)
    return placed(gaussians, 1.0, ply_from_frame(frame), torch.zeros(3))


def spz_antialiased(path: Path) -> bool:
    """True when the file records that its splats were optimized with the 2D filter of Mip-Splatting."""
    with opened(path) as (file, _):
        if _is_gzip(file, path):
            data: bytes | bytearray = GzipStream(file, path).take(_HEADER.size)
        else:
            data = read_exactly(file, _HEADER.size, path, "its header")
        return bool(_parse(data, path, (2, 3, 4)).flags & _ANTIALIASED)


def _is_gzip(file: BinaryIO, path: Path) -> bool:
    """True for versions 2 and 3, False for 4, InputError for anything else; the position stays at the start."""
    start = file.read(4)
    file.seek(0)
    if start[:2] != _GZIP and start != _MAGIC:
        raise InputError(f"{path} must begin as gzip or with `NGSP`, got {start!r}. It is no .spz: check the path.")
    return start[:2] == _GZIP


def _read_gzip(file: BinaryIO, size: int, path: Path) -> tuple[_Header, list[bytearray], bytes]:
    stream = GzipStream(file, path)
    header = _parse(stream.take(_HEADER.size), path, (2, 3))
    check_budget(header.decoded, size, path)
    if needs_check(sum(header.sizes), size):
        stream.skip(sum(header.sizes))
        _finish(stream, header)
        stream = GzipStream(file, path)
        stream.skip(_HEADER.size)
    streams = [stream.take(count) for count in header.sizes]
    return header, streams, _finish(stream, header)


def _finish(stream: GzipStream, header: _Header) -> bytes:
    """The extensions, which follow the last attribute, having compared the checksum."""
    extensions = stream.rest(_MAX_EXTENSIONS) if header.flags & _HAS_EXTENSIONS else b""
    stream.finish()
    return extensions


def _read_zstandard(file: BinaryIO, size: int, path: Path) -> tuple[_Header, list[bytearray], bytes]:
    header = _parse(read_exactly(file, _HEADER.size, path, "its header"), path, (4,))
    (table,) = _TABLE_OFFSET.unpack(read_exactly(file, _TABLE_OFFSET.size, path, "its header"))
    check_budget(header.decoded, size, path)
    expected = [count for count in header.sizes if count]
    begin = _HEADER.size + _TABLE_OFFSET.size
    if header.streams != len(expected) or not begin <= table <= begin + _MAX_EXTENSIONS:
        want = f"{len(expected)} streams and a table at byte {begin} or soon after"
        raise InputError(f"{path} must have {want}, got {header.streams} and {table}. Export it again.")
    records = read_exactly(file, table - begin, path, "its extensions")
    entries = [_SIZES.unpack(read_exactly(file, _SIZES.size, path, "its table")) for _ in expected]
    begin = file.tell()
    if needs_check(sum(expected), size):
        for entry, count in zip(entries, expected, strict=True):
            unzstd(file, entry, count, size, path, keep=False)
        file.seek(begin)
    streams = [unzstd(file, entry, count, size, path) for entry, count in zip(entries, expected, strict=True)]
    extensions = records if header.flags & _HAS_EXTENSIONS else b""
    return header, streams + [bytearray()] * (len(header.sizes) - len(streams)), extensions


def _parse(data: bytes | bytearray, path: Path, versions: tuple[int, ...]) -> _Header:
    magic, version, count, degree, fraction_bits, flags, last = _HEADER.unpack(data)
    if magic != _MAGIC:
        raise InputError(f"{path} must hold the mark `NGSP`, got {magic!r}. It is no .spz: check the path.")
    if version not in versions:
        raise InputError(f"{path}: .spz version must be 2, 3 or 4, got {version}. Export it again as version 3.")
    if degree > _MAX_FILE_DEGREE:
        raise InputError(f"{path}: SH degree must be 0 to {_MAX_FILE_DEGREE}, got {degree}. Export it with degree 3.")
    if flags & ~(_ANTIALIASED | _HAS_EXTENSIONS):
        raise InputError(f"{path}: its flags {flags:#x} are not known. Export it as version 3.")
    if count > _MAX_SPLATS or fraction_bits > _MAX_FRACTION:
        raise InputError(
            f"{path} claims {count} splats with {fraction_bits} fraction bits. It is damaged: export again."
        )
    return _Header(version, count, degree, fraction_bits, flags, last)
