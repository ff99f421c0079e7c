"""This module reads USD files in forks of one process that has imported Pixar's library: milliseconds each, where the
product takes half a second to start a process anew for every file.

Run as a program it reads paths from its input and writes the exit code of each fork: python usd_forks.py.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from unittest.mock import patch

PROBE = Path(__file__).resolve().parents[2] / "gsopt" / "formats" / "usd_probe.py"
MEMORY = 1 << 30
"""Bytes that a fork may take, as the fuzzer's own process."""


@cache
def server() -> subprocess.Popen[str]:
    """The process that forks; it ends when its input does."""
    command = [sys.executable, "-P", __file__]
    return subprocess.Popen(
        command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )


def exit_code(path: Path) -> int:
    """The end of a fork that reads the file, as `usd.probe_exit_code` reports that of a process."""
    pipes = server()
    assert pipes.stdin is not None
    assert pipes.stdout is not None
    pipes.stdin.write(f"{path.absolute()}\n")
    pipes.stdin.flush()
    return int(pipes.stdout.readline())


@contextmanager
def in_forks() -> Iterator[None]:
    """Lets the reader of USD ask the forks."""
    with patch("gsopt.formats.usd.probe_exit_code", exit_code):
        yield


def serve() -> None:
    sys.path.insert(0, str(PROBE.parent))
    import numpy as np  # noqa: F401 (imported for the forks, as the next line)
    from pxr import Sdf, Usd, UsdGeom, UsdVol  # type: ignore[import-not-found]  # noqa: F401
    from usd_probe import probe  # type: ignore[import-not-found]

    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            limit_memory()
            with suppress(Exception):
                probe(line.removesuffix("\n"))
            os._exit(0)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


if __name__ == "__main__":
    serve()
