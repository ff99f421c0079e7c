"""Reads and writes of splat files: bounded reads, whole-or-nothing writes."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gsopt.errors import InputError
from gsopt.events import create, sync_folder

_REMEDIES = {
    errno.ENOSPC: "The disk is full: free some space or choose another disk. An older file of that name is untouched.",
    errno.EDQUOT: "Your quota is used up: free some space or choose another disk. An older file is untouched.",
    errno.ENOENT: "Create the folder first.",
    errno.EACCES: "Choose a folder you may write to.",
    errno.EROFS: "Choose a folder you may write to.",
    errno.ENAMETOOLONG: "Choose a shorter name.",
}


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A binary file that becomes `path` when the block ends well; on any failure `path` stays as it was.

    Written under a temporary name in the same folder, flushed to disk, then renamed. Raises InputError when the
    disk refuses (full, read-only, no such folder).
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with create(temporary) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "Free some space or choose another folder.")
        raise InputError(f"Cannot write {path}: {error.strerror or error}. {remedy}") from error
    finally:
        _remove(temporary)


def _remove(temporary: Path) -> None:
    try:
        temporary.unlink(missing_ok=True)
    except OSError:
        return  # the folder is gone or not writable: no temporary file is left


@contextmanager
def opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """(open file, its size in bytes) of a regular file; InputError when there is none or it cannot be read."""
    try:
        if not path.is_file():
            found = "a folder" if path.is_dir() else "a device or pipe" if path.exists() else "nothing"
            raise InputError(f"A splat file is needed at {path}, got {found}. Check the path.")
        with open(path, "rb") as file:
            yield file, os.fstat(file.fileno()).st_size
    except OSError as error:
        raise InputError(
            f"Cannot read {path}: {error.strerror or error}. Check the path and its permissions."
        ) from error


def read_exactly(file: BinaryIO, count: int, path: Path, what: str) -> bytes:
    """`count` bytes; InputError names `what` at an early end. The caller has checked `count` against the file size."""
    data = file.read(count)
    if len(data) != count:
        raise InputError(f"{path} ends inside {what}: {count} bytes needed, got {len(data)}. Export or copy it again.")
    return data
