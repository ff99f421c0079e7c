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

    from gsopt.events import refuse_links
    from gsopt.results.finished_run import open_run
    from gsopt.results.measure import UNITS_FILE, distance, meters, record_scale, units_of

    length = None if flags.unit_length is None else meters(flags.unit_length)
    run = open_run(flags.run)
    units = units_of(flags.run)
    found = distance(run, flags.start, flags.end)
    if length is not None:
        refuse_links(flags.run)
        units = record_scale(flags.run, length, flags.start, flags.end, found)
        print(f"{flags.run / UNITS_FILE}: 1 scene unit is {units.meters_per_unit:.6g} m")
    known = "" if units.meters_per_unit is None else f", {found * units.meters_per_unit:.6g} m"
    print(f"{found:.6g} scene units{known}")
    return 0
