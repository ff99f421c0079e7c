"""`gsopt demo`: train on the small scene that ships with gsopt, then say which report to open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated

import tyro

import gsopt
from gsopt.errors import InputError

SCENE = Path(gsopt.__file__).parent / "demo"


@dataclass(frozen=True)
class Flags:
    """Train on the small scene that ships with gsopt and write a report."""

    run: Annotated[Path | None, tyro.conf.arg(aliases=["-m"])] = None
    """Folder to write to; runs/demo, or the first free runs/demo-2, runs/demo-3, ... when not given."""
    iterations: int = 1600
    """Training steps."""


def main(argv: Sequence[str]) -> int:
    """Train; the exit code is that of `gsopt train`. Raises InputError when the scene is not there."""
    flags = tyro.cli(Flags, prog="gsopt demo", args=argv)
    if not (SCENE / "transforms_train.json").is_file():
        raise InputError(f"The demo scene must lie in {SCENE}, got nothing there. Install gsopt again.")
    run = flags.run or free_folder(Path("runs"))

    from gsopt.cli import train

    code = train.main([str(SCENE), "-m", str(run), "--iterations", str(flags.iterations)])
    report = run / "report.html"
    if code == 0 and report.is_file():
        print(f"Open {report.resolve()} in a browser.")
    return code


def free_folder(parent: Path) -> Path:
    """`demo`, or the first of demo-2, demo-3, ... that does not exist: an earlier demo is kept."""
    names = ("demo" if number == 1 else f"demo-{number}" for number in count(1))
    return next(folder for name in names if not (folder := parent / name).exists())
