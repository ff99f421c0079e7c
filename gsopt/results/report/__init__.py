"""One self-contained page about a run: report.html needs no network and no other file."""

from __future__ import annotations

from pathlib import Path

from gsopt.config.train import TrainConfig
from gsopt.events import write_atomic
from gsopt.results.report.page import page
from gsopt.results.report.read_run import read_run

__all__ = ["write_report"]


def write_report(run: Path) -> Path:
    """Write RUN/report.html from what the run directory and its dataset hold, and return its path.

    What is missing (figures, splats, dataset) is said on the page instead. Raises InputError when the folder has no
    readable config.json or report.html cannot be written.
    """
    run = Path(run)
    config = TrainConfig.read(run / "config.json")
    path = run / "report.html"
    write_atomic(path, page(read_run(run, config)).encode())
    return path
