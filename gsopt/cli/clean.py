"""`gsopt clean`: leave out splats that no input view needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gsopt import check
from gsopt.errors import UsageError

if TYPE_CHECKING:
    from gsopt.results.clean import Finding


@dataclass(frozen=True)
class Flags:
    """Leave out splats that no input view needs: unseen ones, haze before the cameras, background outside the masks."""

    source: tyro.conf.Positional[Path]
    """A finished run, whose splat.ply is replaced (--undo brings it back), or a splat file, for which -o is needed."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the cleaned splats to this file and leave the source as it is."""
    dry_run: bool = False
    """Only print the counts and, for a run, write its clean.png."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Leave out splats outside of this box too: x y z X Y Z, scene units."""
    undo: bool = False
    """Bring back the splat.ply of before the first cleaning."""
    force: bool = False
    """Replace OUT if it exists."""


def main(argv: Sequence[str]) -> int:
    """Clean, print counts per rule and return 0."""
    flags = tyro.cli(Flags, prog="gsopt clean", args=list(argv))
    is_run = flags.source.is_dir()
    if flags.out is not None:
        check.writable(flags.out, flags.force)
    if flags.undo:
        from gsopt.results.clean_files import undo

        undo(flags.source)
        print(f"{flags.source}/splat.ply is as it was before it was cleaned")
        return 0
    if not is_run and flags.out is None and not flags.dry_run:
        raise UsageError(f"`--out` is needed to clean the file {flags.source}. Add -o OUT, or --dry-run.")
    return clean_run(flags) if is_run else clean_file(flags)


def clean_run(flags: Flags) -> int:
    """Decide by the input views of a run."""
    from gsopt.formats import save_splats
    from gsopt.results import clean, clean_files
    from gsopt.results.finished_run import open_run
    from gsopt.results.measure import units_of

    run = open_run(flags.source)
    views = clean_files.input_views(run)
    found = clean.findings(run, views, flags.box)
    keep = clean.kept(found, len(run.gaussians))
    report(found, len(keep))
    clean_files.write_picture(run, keep, views)
    print(f"before, after and what goes: {flags.source / clean_files.PICTURE}")
    if flags.dry_run:
        return 0
    if flags.out is not None:
        units = units_of(flags.source)
        save_splats(flags.out, run.gaussians.select(keep), antialiased=run.config.antialiased, units=units)
    elif not bool(keep.all()):
        clean_files.replace_splats(run, keep)
        print(f"{flags.source}/splat.ply replaced; `gsopt clean {flags.source} --undo` brings it back")
    return 0


def clean_file(flags: Flags) -> int:
    """Decide by the splats alone."""
    from gsopt.formats import is_antialiased, load_splats, save_splats
    from gsopt.results import clean
    from gsopt.results.measure import units_of

    gaussians = load_splats(flags.source)
    found = clean.findings_without_views(gaussians, flags.box)
    report(found, len(gaussians))
    if flags.out is not None and not flags.dry_run:
        keep = clean.kept(found, len(gaussians))
        save_splats(
            flags.out, gaussians.select(keep), antialiased=is_antialiased(flags.source), units=units_of(flags.source)
        )
    return 0


def report(found: list[Finding], count: int) -> None:
    """Print a line per rule and the sum."""
    gone = 0
    for finding in found:
        named = int(finding.splats.sum())
        gone += named * finding.followed
        change = "" if finding.change is None else f", input views {finding.change:+.3f} dB"
        print(
            f"{finding.rule}: {named:,} splats{change}{'' if finding.followed else ', kept: the input views need them'}"
        )
    print(f"{gone:,} of {count:,} splats go, {count - gone:,} stay")
