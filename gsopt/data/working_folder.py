"""A folder to work in, beside the one that is to appear complete or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsopt.errors import InputError


@contextmanager
def working_folder(out: Path) -> Iterator[Path]:
    """A hidden folder beside `out`, gone afterwards whatever happens."""
    work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        work.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"Cannot write beside {out}: {error.strerror or error}. Choose another `--out`.") from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
