"""Fuzzes one target, guided by coverage: FUZZ_TARGET=NAME python fuzz.py [libFuzzer's flags and corpus folders].

`campaign.py` (`make fuzz`) runs it on every target. The name is no argument because libFuzzer starts itself anew with
its arguments.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
from pathlib import Path

import atheris

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]
# The editable install finds gsopt by a loader of its own, which atheris cannot instrument; the sources are on the path.
sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != "ScikitBuildInplaceFinder"]
with atheris.instrument_imports(include=["gsopt", "blender_addon"]):
    from targets import TARGETS, place, seeds_of

    TARGET = TARGETS[os.environ["FUZZ_TARGET"]]
    with tempfile.TemporaryDirectory() as scratch:
        for seed in seeds_of(TARGET):  # what is imported late is instrumented too
            place(TARGET, Path(scratch)).write_bytes(seed)
            TARGET.law(Path(scratch) / TARGET.file)

MEMORY = 1 << 30
"""Bytes that a small file may make its reader ask for."""


def limit_memory() -> None:
    """Address space as it is now and MEMORY more; a child, which libFuzzer starts to merge, sets a limit of its own."""
    pages, (_, most) = int(Path("/proc/self/statm").read_text().split()[0]), resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, most))


def main() -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        path = place(TARGET, Path(folder))

        def one_input(data: bytes) -> None:
            path.write_bytes(data)
            TARGET.law(path)

        atheris.Setup([f"{sys.executable} {__file__}", *sys.argv[1:]], one_input)
        limit_memory()
        atheris.Fuzz()


if __name__ == "__main__":
    main()
