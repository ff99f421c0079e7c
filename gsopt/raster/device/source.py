"""The text of the kernels: this folder's `kernels.h` and what it includes, in one string."""

from __future__ import annotations

import functools
import re
from pathlib import Path

FOLDER = Path(__file__).parent
INCLUDE = re.compile(r'^#include "([^"]+)"$')


@functools.cache
def program(simt: Path = FOLDER / "simt.h") -> str:
    """All kernels. `simt` says what a thread, a phase and a barrier are; tests give one for a processor."""
    return _with_includes(FOLDER / "kernels.h", {FOLDER / "simt.h": simt}, set())


def _with_includes(path: Path, replaced: dict[Path, Path], seen: set[Path]) -> str:
    """The text of a file, every file that it includes put in its place once."""
    path = replaced.get(path, path)
    if path in seen:
        return ""
    seen.add(path)
    lines = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        match = INCLUDE.match(line)
        if match:
            lines.append(_with_includes((path.parent / match[1]).resolve(), replaced, seen))
            lines.append(f'#line {number + 1} "{path.name}"')
        elif line != "#pragma once":
            lines.append(line)
    return f'#line 1 "{path.name}"\n' + "\n".join(lines) + "\n"
