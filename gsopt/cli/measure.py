"""`gsopt measure`: lengths in a run, and its scale from a length that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Flags:
    """Print the distance between two points of a run; a length that is known gives the run its scale."""

    run: tyro.conf.Positional[Path]
    """The run directory that `gsopt train` wrote."""
    start: Annotated[str, tyro.conf.arg(name="from")]
    """A point: X,Y,Z in scene units (as --from=-1,0,2), or VIEW@COLUMN,ROW for what that pixel of a view shows."""
    end: Annotated[str, tyro.conf.arg(name="to")]
    """The other point."""
    unit_length: str | None = None
    """The true length between the two, as 0.25m or 10in: RUN/units.json keeps the scale for exports and Blender."""


def main(argv: Sequence[str]) -> int:
    """Measure, print and return 0."""
    flags = tyro.cli(Flags, prog="gsopt measure", args=list(argv))

    from gsopt.results.measure import UNITS_FILE, measure

    found = measure(flags.run, flags.start, flags.end, flags.unit_length or "")
    if flags.unit_length and found.meters is not None:
        print(f"{flags.run / UNITS_FILE}: 1 scene unit is {found.meters / found.units:.6g} m")
    known = "" if found.meters is None else f", {found.meters:.6g} m"
    print(f"{found.units:.6g} scene units{known}")
    return 0
