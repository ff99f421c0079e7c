"""Checked reading of a dataset's files: regular files only, bounded sizes, and an InputError that names the file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gsopt.errors import InputError, shortened

MAX_LINE = 64 << 20
"""Characters; a COLMAP keypoint line with a million points is 30 MB."""
MAX_JSON_BYTES = 256 << 20
"""Far above any dataset (10,000 frames are 10 MB), far below what would exhaust memory."""


def is_regular(path: Path) -> bool:
    """True for a regular file (symbolic links followed); False for anything else, and for names no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def child(folder: Path, name: str) -> Path:
    """`name` as a dataset writes it (either slash, `./`, absolute or with `..`), seen from `folder`."""
    return folder / name.replace("\\", "/")


def relative_name(path: Path, folder: Path) -> str:
    """`path` relative to `folder` with forward slashes, or absolute when it lies elsewhere."""
    try:
        return path.relative_to(folder).as_posix()
    except ValueError:
        return path.as_posix()


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. InputError when the file is missing, too large, empty, broken or not an object."""
    remedy = "Export the dataset again, or restore the file."
    if not is_regular(path):
        raise InputError(f"{path} is not a readable file. {remedy}")
    try:
        size = path.stat().st_size
        if size > MAX_JSON_BYTES:
            raise InputError(f"{path} is {size:,} bytes, more than the {MAX_JSON_BYTES:,} read at most. {remedy}")
        text = path.read_text(encoding="utf-8-sig")
        if not text.strip():
            raise InputError(f"{path} is empty; a JSON object with `frames` was expected. {remedy}")
        document = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON: {error}. {remedy}") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} must hold a JSON object, got {type(document).__name__}. {remedy}")
    return document


def number(value: Any, where: str) -> float:
    """A finite float from parsed JSON; InputError naming `where` otherwise."""
    try:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError
        result = float(value)
        if not math.isfinite(result):
            raise ValueError
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where} must be a finite number, got {shortened(value)}. Correct the file.") from error
    return result


def read_lines(path: Path) -> Iterator[str]:
    """The lines of a text file, one at a time, each at most MAX_LINE characters; InputError when it cannot be read."""
    try:
        with open(path, encoding="utf-8", errors="surrogateescape") as file:
            while line := file.readline(MAX_LINE + 1):
                if len(line) > MAX_LINE:
                    raise InputError(f"{path} has a line of more than {MAX_LINE:,} characters. Export it again.")
                yield line
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}. Export it again.") from error
