"""Shape libraries on disk: one safetensors file, nothing in it is code, read entry by entry.

    metadata    library: JSON with `format` and `entries`, a list of id, name, category, words, license, creator
    sizes       float32 [N, 3], sides of each box, the longest 1
    offsets     int64 [N + 1], where each shape begins in `shapes`
    shapes      uint8 [B], each a zlib stream of packed occupancy (48³ bits) and colors (12³ x 3 bytes)

The file is untrusted: every number is compared with the file's size before memory is taken, and a stream is never
inflated beyond what one shape takes.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gsopt.errors import InputError
from gsopt.events import write_atomic
from gsopt.shape_library.entry import COLOR_SIDE, MAX_TEXT_LENGTH, SIDE, Entry, Shape

FORMAT = "gsopt-shape-library-1"
BUNDLED = Path(__file__).parents[1] / "weights" / "shape_library.safetensors"
"""The library that ships with gsopt; weights/SHAPE_LIBRARY.md says what it was made from."""
MAX_ENTRIES = 100_000
MAX_FILE_BYTES = 2 << 30
OCCUPANCY_BYTES = SIDE**3 // 8
SHAPE_BYTES = OCCUPANCY_BYTES + 3 * COLOR_SIDE**3
TENSORS = {"sizes": ("F32", 2), "offsets": ("I64", 1), "shapes": ("U8", 1)}
"""Type and number of axes of each tensor."""


class ShapeLibrary:
    """The entries of a library; shapes are read when they are asked for."""

    def __init__(self, path: Path) -> None:
        """Raises InputError for a file that is missing, broken or no library."""
        self.path = path
        try:
            if path.stat().st_size > MAX_FILE_BYTES:
                raise ValueError(f"it is larger than {MAX_FILE_BYTES:,} bytes")
            self._file = safe_open(str(path), framework="numpy")
            self.entries = _entries(self._file.metadata() or {})
            self._offsets, self._sizes = _arrays(self._file, len(self.entries))
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise self._broken(str(error) or type(error).__name__) from error

    def __len__(self) -> int:
        return len(self.entries)

    def shape(self, index: int) -> Shape:
        """Reads one shape. Raises InputError for a broken one."""
        start, stop = int(self._offsets[index]), int(self._offsets[index + 1])
        stream = bytes(self._file.get_slice("shapes")[start:stop]) if stop > start else b""
        try:
            inflater = zlib.decompressobj()
            data = inflater.decompress(stream, SHAPE_BYTES + 1)
        except zlib.error as error:
            raise self._broken(f"entry {index} is damaged ({error})") from error
        if len(data) != SHAPE_BYTES:
            raise self._broken(f"entry {index} holds {len(data)} bytes or more, not {SHAPE_BYTES}")
        values = np.frombuffer(data, np.uint8)
        occupied = np.unpackbits(values[:OCCUPANCY_BYTES]).reshape((SIDE,) * 3).astype(bool)
        colors = values[OCCUPANCY_BYTES:].reshape(COLOR_SIDE, COLOR_SIDE, COLOR_SIDE, 3)
        if not occupied.any():
            raise self._broken(f"entry {index} is empty")
        return Shape(occupied, colors, self._sizes[index])

    def _broken(self, reason: str) -> InputError:
        return InputError(
            f"Cannot read the shape library {self.path}: {reason:.200}. Make it again with `gsopt finetune --library`, "
            "or name another file."
        )


def write_library(path: Path, entries: Sequence[Entry], shapes: Sequence[bytes], sizes: Sequence[np.ndarray]) -> None:
    """Writes a library whole or not at all; the same content gives the same bytes."""
    offsets = np.cumsum([0, *map(len, shapes)], dtype=np.int64)
    tensors: dict[str, Any] = {
        "sizes": np.stack(sizes).astype(np.float32),
        "offsets": offsets,
        "shapes": np.frombuffer(b"".join(shapes), np.uint8),
    }
    head = {"format": FORMAT, "entries": [asdict(entry) for entry in entries]}
    write_atomic(path, save(tensors, {"library": json.dumps(head, ensure_ascii=False, sort_keys=True)}))


def packed(shape: Shape) -> bytes:
    """The stream of one shape."""
    return zlib.compress(np.packbits(shape.occupied).tobytes() + shape.colors.tobytes(), 9)


def _entries(metadata: dict[str, str]) -> tuple[Entry, ...]:
    """The entries that the metadata describes. Raises ValueError."""
    head = json.loads(metadata.get("library", "null"))
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise ValueError(f"it is no {FORMAT}")
    rows = head["entries"]
    if not isinstance(rows, list) or not 0 < len(rows) <= MAX_ENTRIES:
        raise ValueError(f"it must list 1 to {MAX_ENTRIES:,} entries")
    return tuple(map(_entry, rows))


def _entry(row: Any) -> Entry:
    known = {field.name for field in fields(Entry)}
    if not isinstance(row, dict) or set(row) - known or not all(isinstance(text, str) for text in row.values()):
        raise ValueError(f"an entry holds other than texts under {', '.join(sorted(known))}")
    if not row.get("id") or any(len(text) > MAX_TEXT_LENGTH for text in row.values()):
        raise ValueError(f"an entry has no id or a text beyond {MAX_TEXT_LENGTH} characters")
    return Entry(**{key: printable(text) for key, text in row.items()})


def printable(text: str) -> str:
    """The text on one line, without what could steer a terminal."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def _arrays(file: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and sizes of `count` entries. Raises ValueError."""
    shape = {}
    for name, (kind, axes) in TENSORS.items():
        part = file.get_slice(name)
        shape[name] = part.get_shape()
        if part.get_dtype() != kind or len(shape[name]) != axes:
            raise ValueError(f"`{name}` is {part.get_dtype()} {shape[name]}")
    if shape["sizes"] != [count, 3] or shape["offsets"] != [count + 1]:
        raise ValueError(f"{count} entries do not fit sizes {shape['sizes']} and offsets {shape['offsets']}")
    offsets, sizes = file.get_tensor("offsets"), file.get_tensor("sizes")
    if offsets[0] != 0 or offsets[-1] != shape["shapes"][0] or (np.diff(offsets) < 0).any():
        raise ValueError("its offsets do not rise from 0 to the end")
    if not (np.isfinite(sizes).all() and (sizes > 0).all() and np.allclose(sizes.max(axis=1), 1)):
        raise ValueError("its sizes are not above 0 with 1 as the longest")
    return offsets, sizes
