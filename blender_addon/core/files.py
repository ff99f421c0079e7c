"""Files that are whole or not there, and small ones that are read with a bound."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from .errors import InputError

LARGEST_JSON = 4 << 20
"""Bytes of a JSON file that are read on the main thread."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write to that takes the name `path` when all is written; InputError leaves what was there."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        try:
            with open(temporary, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except OSError as error:
            raise InputError(
                f"Cannot write {path}: {error.strerror or error}. Free some space or choose another folder."
            ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def json_object(data: str | bytes) -> dict[str, Any]:
    """Parses a JSON object. ValueError or RecursionError where there is none."""
    document = json.loads(data)
    if not isinstance(document, dict):
        raise ValueError("it holds no object")
    return document


def encoded(value: Any) -> bytes:
    """A value as JSON. InputError for what no JSON file holds: Infinity, NaN, lone surrogates, endless nesting."""
    try:
        return (json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
    except (ValueError, RecursionError) as error:
        raise InputError(f"No JSON file can hold this: {error}. Remove that number, character or depth.") from error


def write_json(path: Path, value: Any) -> None:
    """A whole JSON file or the one that was there before."""
    data = encoded(value)
    with replacing(path) as file:
        file.write(data)


def is_text(value: Any) -> bool:
    """True for text that can be a path: no NUL, no lone surrogate."""
    return isinstance(value, str) and "\0" not in value and not any("\ud800" <= c <= "\udfff" for c in value)


def read_json(path: Path, largest: int = LARGEST_JSON) -> dict[str, Any]:
    """The object in a JSON file. InputError where there is none, or too much."""
    try:
        with open(path, "rb") as file:
            data = file.read(largest + 1)
        if len(data) > largest:
            raise ValueError(f"it is larger than {largest} bytes")
        return json_object(data)
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"Cannot read {path}: {reason}. Choose another one.") from error
