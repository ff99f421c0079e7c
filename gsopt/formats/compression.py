"""Compression of streams, and bounded decompression of untrusted ones."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from gsopt._optional import require
from gsopt.errors import InputError
from gsopt.formats.files import read_exactly

_PIECE = 1 << 16
_GZIP_WINDOW = 16 + zlib.MAX_WBITS
_ALWAYS_ALLOWED = 1 << 23
"""Bytes that any file may decode to (8 MiB, 150,000 splats without view-dependent color)."""
_MAX_RATIO = 50
"""Beyond 8 MiB, a file may decode to this many times its size; runs reach 15, a grid of equal splats 40."""
_UNCHECKED_RATIO = 8
"""A stream that unpacks to more than this many times the file is read to its end before a byte is kept."""


def check_budget(decoded: int, packed: int, path: Path, ratio: int = _MAX_RATIO) -> None:
    """InputError when `decoded` bytes of parameters or pixels out of a file of `packed` bytes are implausible."""
    if decoded > max(_ALWAYS_ALLOWED, ratio * packed):
        raise InputError(
            f"{path} claims to decode from {packed} to {decoded} bytes, {ratio} times its size is the limit. "
            "It is damaged or hostile: export it again."
        )


def needs_check(plain: int, packed: int) -> bool:
    """True when to unpack `packed` bytes to `plain` ones costs too much for a file that may turn out damaged."""
    return plain > max(_ALWAYS_ALLOWED // 2, _UNCHECKED_RATIO * packed)


class GzipStream:
    """A gzip stream from the file's start, decompressed piece by piece."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        file.seek(0)
        self._file, self._path = file, path
        self._zlib = zlib.decompressobj(_GZIP_WINDOW)
        self._pending = b""

    def take(self, count: int) -> bytearray:
        """Exactly `count` unpacked bytes, or InputError where the stream is damaged or ends before."""
        out, done = bytearray(count), 0
        for piece in self._pieces(count):
            out[done : done + len(piece)] = piece
            done += len(piece)
        return out

    def skip(self, count: int) -> None:
        """As `take`, without keeping them."""
        for _ in self._pieces(count):
            pass

    def _pieces(self, count: int) -> Iterator[bytes]:
        while count:
            if self._zlib.eof:
                raise InputError(f"{self._path} ends {count} bytes before its last splat. Copy or export it again.")
            piece = self._step(min(count, _PIECE))
            count -= len(piece)
            yield piece

    def rest(self, limit: int) -> bytes:
        """All unpacked bytes up to the end; InputError beyond `limit`."""
        out = bytearray()
        while not self._zlib.eof and len(out) <= limit:
            out += self._step(limit + 1 - len(out))
        if len(out) > limit:
            raise InputError(f"{self._path} holds more than {limit} bytes of extensions. Export it again.")
        return bytes(out)

    def finish(self) -> None:
        """Reads to the end, where zlib compares the checksum; InputError when it differs or more data follows."""
        while not self._zlib.eof:
            if self._step(1):
                raise InputError(f"{self._path} holds more than its header declares. Export it again.")

    def _step(self, limit: int) -> bytes:
        self._pending = self._pending or self._file.read(_PIECE)
        if not self._pending:
            raise InputError(f"{self._path} was cut short. Copy or export it again.")
        try:
            piece = self._zlib.decompress(self._pending, limit)
        except zlib.error as error:
            raise InputError(f"{self._path} is damaged: {error}. Copy or export it again.") from error
        self._pending = self._zlib.unconsumed_tail
        return piece


def deflated(parts: Iterable[bytes]) -> Iterator[bytes]:
    """The parts as one gzip stream without a time stamp, so that equal splats give equal bytes.

    Run lengths and Huffman codes only: quantized splats have few longer repeats, and a search for them takes ten times
    as long and enlarges the stream.
    """
    packer = zlib.compressobj(6, zlib.DEFLATED, _GZIP_WINDOW, 9, zlib.Z_RLE)
    for part in parts:
        yield packer.compress(part)
    yield packer.flush()


def unzstd(
    file: BinaryIO, sizes: tuple[int, int], count: int, file_size: int, path: Path, *, keep: bool = True
) -> bytearray:
    """The next Zstandard stream: `sizes` = (packed, plain) as claimed, `count` the plain size it must have.

    Without `keep` it is only checked, and nothing is returned.
    """
    packed, plain = sizes
    if plain != count or packed > file_size:
        raise InputError(f"{path} claims a stream of {packed} to {plain} bytes, {count} needed. Export it again.")
    zstandard = require("zstandard", "spz", "Reading .spz version 4")
    data = read_exactly(file, packed, path, "a stream")
    out, done = bytearray(count if keep else 0), 0
    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as reader:
            while piece := reader.read(min(_PIECE, count + 1 - done)):
                if keep:
                    out[done : done + len(piece)] = piece
                done += len(piece)
    except zstandard.ZstdError as error:
        raise InputError(f"{path} is damaged: {error}. Copy or export it again.") from error
    if done != count:
        raise InputError(f"{path}: a stream must unpack to {count} bytes, got {done}. Copy or export it again.")
    return out


def zstandard_compressed(data: bytes) -> bytes:
    """`data` as one Zstandard frame with its size and checksum."""
    zstandard = require("zstandard", "spz", "Writing .spz version 4")
    return bytes(zstandard.ZstdCompressor(level=3, write_checksum=True).compress(data))
