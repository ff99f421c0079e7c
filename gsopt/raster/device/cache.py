"""Compiled kernels on disk: by text, processor and compiler, so that only the first run of a version waits."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

from gsopt.errors import GsoptError
from gsopt.events import write_atomic

DIGEST = hashlib.sha256().digest_size


def folder() -> Path:
    """The cache of this user, where the system keeps such: GSOPT_CACHE replaces it."""
    if own := os.environ.get("GSOPT_CACHE"):
        return Path(own)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"), "gsopt", "kernels")
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "gsopt", "kernels")


def cached(key: str, make: Callable[[], bytes]) -> bytes:
    """The bytes that `make` made of this key once, with a checksum. A folder that refuses costs time, nothing else."""
    try:
        path = folder() / f"{hashlib.sha256(key.encode()).hexdigest()}.bin"
        stored = path.read_bytes()
        if hashlib.sha256(stored[DIGEST:]).digest() == stored[:DIGEST]:
            return stored[DIGEST:]
    except (OSError, RuntimeError):  # no home folder is a RuntimeError
        stored = b""
    made = make()
    try:
        path = folder() / f"{hashlib.sha256(key.encode()).hexdigest()}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, hashlib.sha256(made).digest() + made)
    except (OSError, RuntimeError, GsoptError):
        pass
    return made
