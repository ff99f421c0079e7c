"""Hashes of a run's settings, data and code: a record with the same key need not be measured again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from gsopt.errors import InputError

PACKAGE = Path(__file__).resolve().parents[2]
CODE_SUFFIXES = (".py", ".so", ".pyd", ".npz")
"""Suffixes of files that training or evaluation depend on: sources, the compiled extension, the weights of LPIPS."""
PRESENTATION_FILES = (
    "results/report/",
    "results/viewer.py",
    "benchmark/charts.py",
    "benchmark/markdown.py",
    "benchmark/suite/tables.py",
    "benchmark/suite/html_page.py",
    "benchmark/suite/aggregate.py",
    "farm/",
)
"""Files that present results or say where runs are made: a better table is no reason to measure again."""
KEY_DIGITS = 16
READ_BYTES = 1 << 20


def key(config: Sequence[str], data: str, code: str) -> str:
    """One hash for a run."""
    return digest([json.dumps(list(config)).encode(), data.encode(), code.encode()])


def digest(parts: Iterable[bytes]) -> str:
    """Hash of parts, each preceded by its length."""
    total = hashlib.sha256()
    for part in parts:
        total.update(len(part).to_bytes(8, "little"))
        total.update(part)
    return total.hexdigest()[:KEY_DIGITS]


@cache
def folder_hash(folder: Path) -> str:
    """Names and bytes of all regular files below a folder (links followed). InputError when one cannot be read."""
    return digest(
        part
        for path in sorted(p for p in folder.rglob("*") if p.is_file())
        for part in (path.relative_to(folder).as_posix().encode(), file_hash(path))
    )


def file_hash(path: Path) -> bytes:
    """SHA-256 of a file, read in pieces."""
    total = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while piece := file.read(READ_BYTES):
                total.update(piece)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}. Restore the file or its permissions.") from error
    return total.digest()


@cache
def code_hash(package: Path = PACKAGE) -> str:
    """Hash of every file of the package that a run depends on."""
    files = sorted(p for p in package.rglob("*") if p.suffix in CODE_SUFFIXES and p.is_file())
    names = ((path.relative_to(package).as_posix(), path) for path in files)
    used = ((name, path) for name, path in names if not name.startswith(PRESENTATION_FILES))
    return digest(part for name, path in used for part in (name.encode(), file_hash(path)))
