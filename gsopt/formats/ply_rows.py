"""The rows of one PLY element, in blocks of bounded size, whatever the format, types and byte order of the file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsopt.errors import InputError
from gsopt.formats.ply_header import Element, Header

BLOCK = 1 << 14
"""Rows per block: a block of full splats is 4 MB, which stays in the cache."""
_MAX_TOKEN = 40
"""Characters allowed for one ascii number and the blank after it."""


def seek_element(file: BinaryIO, header: Header, element: Element, file_size: int, path: Path) -> None:
    """Skip to the first row of `element`, having checked that the file can hold every row the header claims."""
    if element.has_lists:
        raise InputError(f"{path}: element `{element.name}` has a list property, which no splat has. Export it again.")
    for before in header.elements[: header.elements.index(element)]:
        if before.has_lists:
            raise InputError(
                f"{path}: element `{before.name}` with its lists stands before `{element.name}`. "
                f"Export the file with `{element.name}` first."
            )
        _check_claim(header, before, file, file_size, path)
        if header.byte_order:
            file.seek(before.count * before.dtype(header.byte_order).itemsize, 1)
        else:
            for _ in range(before.count if before.columns else 0):
                _line(file, before, path)
    _check_claim(header, element, file, file_size, path)


def _check_claim(header: Header, element: Element, file: BinaryIO, file_size: int, path: Path) -> None:
    # An ascii row has at least one digit and one blank or line end per number; the last line end may be absent.
    row = element.dtype(header.byte_order).itemsize if header.byte_order else 2 * len(element.columns)
    need, have = element.count * row, file_size - file.tell()
    if need > have + (not header.byte_order):
        raise InputError(
            f"{path}: the header claims {element.count} rows of `{element.name}`, {need} bytes at least, "
            f"got {max(have, 0)} bytes. The file was cut short or is damaged: copy or export it again."
        )


def float_blocks(file: BinaryIO, header: Header, element: Element, path: Path) -> Iterator[NDArray[np.float32]]:
    """Blocks [rows, columns] as float32, in file order, until `element.count` rows were read."""
    for start in range(0, element.count, BLOCK):
        rows = min(BLOCK, element.count - start)
        if header.byte_order:
            yield _binary_block(file, header, element, rows, path)
        else:
            yield _ascii_block(file, element, start, rows, path)


def raw_blocks(file: BinaryIO, header: Header, element: Element, path: Path) -> Iterator[NDArray[np.void]]:
    """Blocks of structured rows of a binary file, untouched."""
    dtype = element.dtype(header.byte_order)
    for start in range(0, element.count, BLOCK):
        yield _read(file, dtype, min(BLOCK, element.count - start), path)


def _read(file: BinaryIO, dtype: np.dtype, rows: int, path: Path) -> NDArray[np.void]:
    data = file.read(rows * dtype.itemsize)
    if len(data) != rows * dtype.itemsize:
        raise InputError(f"{path} shrank during reading. Wait until no program writes to it, then try again.")
    return np.frombuffer(data, dtype)


def _binary_block(file: BinaryIO, header: Header, element: Element, rows: int, path: Path) -> NDArray[np.float32]:
    dtype = element.dtype(header.byte_order)
    block = _read(file, dtype, rows, path)
    if {kind for _, kind in element.columns} == {"f4"}:
        return block.view(f"{header.byte_order}f4").reshape(rows, len(element.columns)).astype(np.float32, copy=False)
    # a double beyond float32 becomes inf, a signaling NaN a quiet one
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([block[name].astype(np.float32) for name in element.names], axis=1)


def _ascii_block(file: BinaryIO, element: Element, start: int, rows: int, path: Path) -> NDArray[np.float32]:
    block = np.empty((rows, len(element.columns)), np.float64)
    for i in range(rows):
        words = _line(file, element, path).split()
        if len(words) != len(element.columns):
            got, want = len(words), len(element.columns)
            raise InputError(f"{path}: row {start + i} must have {want} numbers, got {got}. Export the file again.")
        try:
            block[i] = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"{path}: row {start + i} holds something that is no number: {error}.") from error
    with np.errstate(over="ignore"):
        return block.astype(np.float32)


def _line(file: BinaryIO, element: Element, path: Path) -> bytes:
    limit = _MAX_TOKEN * (len(element.columns) + 1)
    line = file.readline(limit)
    if len(line) == limit and not line.endswith(b"\n"):
        raise InputError(f"{path}: a row of `{element.name}` is longer than {limit} characters. Export the file again.")
    if not line:
        raise InputError(f"{path} ends before its last row of `{element.name}`. Copy or export it again.")
    return line
