"""Parses the untrusted header of a PLY file.

Format: Greg Turk, "The PLY Polygon File Format" (1994): lines of text from `ply` to `end_header`, then the elements'
rows in the order in which they were declared.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsopt.errors import InputError

MAX_HEADER = 1 << 16
"""Bytes. A splat's header has about 1.5 kB."""
_END = re.compile(rb"\r?\nend_header[ \t]*\r?\n")
_COUNT = re.compile(r"[0-9]{1,18}")
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


@dataclass(frozen=True)
class Element:
    """One `element` line and its properties, in file order."""

    name: str
    count: int
    columns: tuple[tuple[str, str | None], ...]
    """(name, numpy type without byte order), None for a list property."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.columns)

    def columns_of(self, kind: str) -> tuple[str, ...]:
        """Names of the properties of one numpy type, in file order."""
        return tuple(name for name, its_kind in self.columns if its_kind == kind)

    @property
    def has_lists(self) -> bool:
        return any(kind is None for _, kind in self.columns)

    def dtype(self, byte_order: str) -> np.dtype:
        """The packed row; only for an element without list properties."""
        return np.dtype([(name, f"{byte_order}{kind}") for name, kind in self.columns])


@dataclass(frozen=True)
class Header:
    """The text part of a PLY file."""

    byte_order: str
    """"<", ">" or "" for ascii."""
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    size: int
    """Bytes before the first row."""

    def element(self, name: str) -> Element | None:
        """The element of that name, if declared."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(file: BinaryIO, path: Path) -> Header:
    """Parse the header at the start of `file` and leave the position at the first row."""
    head = file.read(MAX_HEADER)
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise InputError(
            f"{path} must begin with the line `ply`, got {head[:12]!r}. It is no PLY file: check the path."
        )
    end = _END.search(head)
    if end is None:
        raise InputError(f"{path} has no `end_header` in its first {len(head)} bytes. It is damaged: export it again.")
    file.seek(end.end())
    lines = head[: end.start()].decode("latin-1").splitlines()[1:]
    return _parse(lines, path, end.end())


def _parse(lines: list[str], path: Path, size: int) -> Header:
    byte_order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    comments = []
    for line in lines:
        words = line.split()
        match words:
            case [] | ["obj_info", *_]:
                continue
            case ["comment", *_]:
                comments.append(line[len("comment") :].strip())
            case ["format", name, "1.0"] if name in _FORMATS and byte_order is None:
                byte_order = _FORMATS[name]
            case ["element", name, count] if _COUNT.fullmatch(count):
                elements.append((name, int(count), []))
            case ["property", "list", count_type, item_type, name] if elements and {count_type, item_type} <= set(
                _TYPES
            ):
                elements[-1][2].append((name, None))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _TYPES[kind]))
            case _:
                raise InputError(f"{path}: this header line makes no sense: {line[:80]!r}. Export the file again.")
    if byte_order is None:
        raise InputError(f"{path} has no `format` line in its header. Export the file again.")
    parsed = tuple(Element(name, count, tuple(columns)) for name, count, columns in elements)
    _check_unique(parsed, path)
    return Header(byte_order, parsed, tuple(comments), size)


def _check_unique(elements: tuple[Element, ...], path: Path) -> None:
    for what, names in [("element", tuple(e.name for e in elements)), *(("property", e.names) for e in elements)]:
        if len(set(names)) != len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"{path} declares the {what} `{twice[:40]}` twice. Keep one and export it again.")
