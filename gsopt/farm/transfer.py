"""Files on their way to a machine that does not see the driver's disk, and results on their way back."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import tarfile
import tempfile
from pathlib import Path

from gsopt.errors import InputError

MAX_BYTES = 2 << 30
"""Largest content of one job's input or result."""
_SCRATCH: list[tempfile.TemporaryDirectory[str]] = []


def stamp(path: Path) -> list[int]:
    """Size and time of a file or folder, equal on all machines that share its disk; empty where it is absent."""
    try:
        found = path.stat()
    except OSError:
        return []
    return [found.st_size, found.st_mtime_ns]


def packed(path: Path) -> bytes:
    """A file or folder as an archive. InputError when it is too large to be sent."""
    size = sum(file.stat().st_size for file in [path, *path.rglob("*")] if file.is_file())
    if size > MAX_BYTES:
        limit = MAX_BYTES >> 30
        raise InputError(f"{path} has {size / 1e9:.1f} GB; {limit} GB can be sent. Put it on a shared disk.")
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", dereference=True) as archive:
        archive.add(path, "content")
    return buffer.getvalue()


def unpacked(content: bytes, place: Path) -> None:
    """Makes `place` from what `packed` returned; it appears whole or not at all."""
    beside = Path(tempfile.mkdtemp(prefix=".unpack-", dir=place.parent))
    try:
        with tarfile.open(fileobj=io.BytesIO(content)) as archive:
            archive.extractall(beside, filter="data")
        os.rename(beside / "content", place)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def scratch() -> Path:
    """A folder of this process, removed at its end."""
    if not _SCRATCH:
        _SCRATCH.append(tempfile.TemporaryDirectory(prefix="gsopt-farm-"))
    return Path(_SCRATCH[0].name)


def received(name: str, content: bytes) -> Path:
    """The place of a sent input on this machine; each content is unpacked once per process."""
    folder = scratch() / hashlib.sha256(content).hexdigest()[:16]
    place = folder / name
    if not place.exists():
        folder.mkdir(exist_ok=True)
        unpacked(content, place)
    return place
