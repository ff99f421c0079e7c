"""Scale of a run or a splat file: how many meters one of its units is."""

from __future__ import annotations

import math
import re
from pathlib import Path

from .errors import InputError
from .files import read_json

FILE = "units.json"
MAX_HEADER = 1 << 14
COMMENT = re.compile(rb"^comment meters per unit: (\S+)\r?$", re.MULTILINE | re.IGNORECASE)


def meters_per_unit(source: Path) -> float:
    """The scale that `gsopt measure` gave to a run, or that a PLY carries; 1 where there is none."""
    run = source if source.is_dir() else source.parent
    if (run / FILE).is_file():
        try:
            return usable(read_json(run / FILE)["meters_per_unit"])
        except (InputError, KeyError, TypeError):
            return 1.0
    if source.suffix.lower() != ".ply" or not source.is_file():
        return 1.0
    with source.open("rb") as file:
        found = COMMENT.search(file.read(MAX_HEADER).partition(b"end_header")[0])
    return usable(found[1]) if found else 1.0


def usable(value: object) -> float:
    """A finite number above 0, else 1: a note that cannot be read moves nothing."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return 1.0
    return number if 0 < number < math.inf else 1.0
