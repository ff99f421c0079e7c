"""report.html: one self-contained page about a run, without network or other files."""

from __future__ import annotations

from pathlib import Path

from gsopt.config.train import TrainConfig
from gsopt.events import encoded, write_atomic
from gsopt.results.report.page import page
from gsopt.results.report.read_run import read_run

__all__ = ["write_report"]


def write_report(run: Path) -> Path:
    """Writes RUN/report.html from the run directory and its dataset, and returns its path.

    The page names missing parts (metrics, splats, dataset). Raises InputError when the folder has no
    readable config.json or report.html cannot be written.
    """
    run = Path(run)
    config = TrainConfig.read(run / "config.json")
    path = run / "report.html"
    write_atomic(path, encoded(page(read_run(run, config))))
    return path
