"""Reads the container of an untrusted .glb and its JSON.

Source: Khronos, glTF 2.0, section 4.4 (binary glTF layout).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from gsopt.errors import InputError, shortened
from gsopt.formats.files import read_exactly

MAGIC = b"glTF"
JSON, BINARY = b"JSON", b"BIN\0"
HEADER = struct.Struct("<4sII")
CHUNK = struct.Struct("<I4s")
_MAX_JSON = 1 << 20
_ALWAYS_ALLOWED_JSON = 300 << 10
"""Bytes. A file of splats alone has about 10 kB. Parsed JSON takes up to 25 times its text."""
_JSON_SHARE = 0.3
"""Beyond the 300 kB that are always allowed, the JSON is at most this share of a file."""


@dataclass(frozen=True)
class Document:
    """The JSON of a .glb and where its binary chunk lies; every access checks the type it finds."""

    root: Mapping[str, Any]
    start: int
    """First byte of the binary chunk in the file."""
    length: int
    path: Path
    _lists: dict[str, list[Mapping[str, Any]]] = field(default_factory=dict)
    """The root's lists of objects, each checked once."""

    def fail(self, what: str) -> NoReturn:
        """Raise InputError: `what` is wrong with this file."""
        raise InputError(f"{self.path}: {what}. Export it again.")

    def object(self, owner: Mapping[str, Any], key: str) -> Mapping[str, Any]:
        """The object at `key`, empty when absent."""
        value = owner.get(key, {})
        return value if isinstance(value, dict) else self.fail(f"`{key}` must be an object, got {shortened(value)}")

    def objects(self, owner: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
        """The list of objects at `key`, empty when absent."""
        value = owner.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            self.fail(f"`{key}` must be a list of objects, got {shortened(value)}")
        return value

    def integer(self, owner: Mapping[str, Any], key: str, default: int | None = None) -> int:
        """The integer >= 0 at `key`; when absent `default`, or InputError where that is None."""
        value = owner.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            self.fail(f"`{key}` must be an integer >= 0, got {shortened(value)}")
        return value

    def item(self, key: str, index: int) -> Mapping[str, Any]:
        """Object number `index` of a list of the root."""
        items = self._lists.get(key)
        if items is None:
            items = self._lists[key] = self.objects(self.root, key)
        if index >= len(items):
            self.fail(f"`{key}` must have an item {index}, got {len(items)} items")
        return items[index]

    def names(self, key: str) -> list[str]:
        """The list of strings at `key` of the root."""
        value = self.root.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            self.fail(f"`{key}` must be a list of names, got {shortened(value)}")
        return value


def read_container(file: BinaryIO, file_size: int, path: Path) -> Document:
    """Read header and JSON of a .glb and find its binary chunk, which is not read."""
    magic, version, total = HEADER.unpack(read_exactly(file, HEADER.size, path, "its header"))
    if magic != MAGIC or version != 2:
        raise InputError(f"{path} must begin as binary glTF 2, got {magic!r} {version}. It is no .glb: check the path.")
    if total > file_size:
        raise InputError(f"{path} claims {total} bytes, got {file_size}. It was cut short: copy or export it again.")
    text = _chunk(file, file_size, path, JSON)
    limit = min(_MAX_JSON, max(_ALWAYS_ALLOWED_JSON, int(_JSON_SHARE * file_size)))
    if text > limit:
        raise InputError(f"{path}: the JSON may have {limit} bytes, got {text}. Export the splats on their own.")
    root = _parse(read_exactly(file, text, path, "its JSON"), path)
    length = _chunk(file, file_size, path, BINARY)
    return Document(root, file.tell(), length, path)


def _chunk(file: BinaryIO, file_size: int, path: Path, kind: bytes) -> int:
    """Length of the chunk that starts here, which must be of this kind and fit the file."""
    length, got = CHUNK.unpack(read_exactly(file, CHUNK.size, path, f"the chunk {kind!r}"))
    if got != kind or length > file_size - file.tell():
        have = file_size - file.tell()
        raise InputError(
            f"{path} must have a chunk {kind!r} of at most {have} bytes here, got {got!r} of {length}. Export it again."
        )
    return int(length)


def _parse(text: bytes, path: Path) -> Mapping[str, Any]:
    try:
        root = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its JSON is broken: {error}. Export it again.") from error
    if not isinstance(root, dict):
        raise InputError(f"{path}: its JSON must be an object, got {type(root).__name__}. Export it again.")
    return root
