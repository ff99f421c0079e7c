"""A folder to work in, beside the one that is to appear complete or not at all."""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsopt.errors import InputError
from gsopt.events import writer_is_dead


@contextmanager
def working_folder(out: Path) -> Iterator[Path]:
    """A hidden folder beside `out`, gone afterwards whatever happens; those of killed runs go first."""
    work = out.with_name(f".{out.name}.{os.getpid()}.tmp")
    try:
        sweep(out)
        work.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"Cannot write beside {out}: {error.strerror or error}. Choose another `--out`.") from error
    try:
        yield work
    finally:
        for _ in range(2):  # a disk that failed once may work again
            shutil.rmtree(work, ignore_errors=True)


def sweep(out: Path) -> None:
    """Removes the working folders that runs for `out` left when they were killed."""
    if os.name != "posix":  # elsewhere one cannot ask for a process without harm
        return
    for other in out.parent.glob(f".{glob.escape(out.name)}.*.tmp"):
        if other.is_dir() and not other.is_symlink() and writer_is_dead(other):
            shutil.rmtree(other, ignore_errors=True)
