"""Lines for the user: progress of a run (live on a terminal, else plain, and in log.txt) and checks of output files."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

PLAIN_SHARE = 0.1
"""A plain line is written whenever this share of the steps has passed."""


def report(line: str) -> None:
    """Print one line at once, also when stdout is a pipe."""
    print(line, flush=True)


class RunConsole:
    """Prints a run's events; `say` prints any other line."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._console = Console(highlight=False, soft_wrap=True)
        self._live: Progress | None = None
        self._task = TaskID(0)
        self._log: TextIO | None = None
        self._tenths = 0

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Print one event."""
        match event["kind"]:
            case "started":
                self.say(started_line(event, self._run))
                if (expected := event.get("estimate")) is not None:
                    self.say(estimate_line(expected))
                if (guidance := event.get("guidance")) is not None and guidance["prior"] is None:
                    self.say(f"guidance off: {guidance['reason']}")
                self._tenths = _tenths(event)
                self._begin(event)
            case "warning":
                self.say(f"warning: {event['message']}")
            case "guidance" | "library" | "shape_prior" | "cells" as kind:
                self.say(f"{kind.replace('_', ' ')}: {event['message']}")
            case "progress":
                self._progress(event)
            case "evaluation":
                self._evaluation(event)
            case "stopped":
                self.close()
                self.say(f"stopped after step {event['step']}; continue with: gsopt train --resume -m {self._run}")
            case "error":
                self.close()
                self._write_log(f"error: {event['message']}")

    def say(self, line: str) -> None:
        """Print a line and keep it in log.txt."""
        self._console.print(line, markup=False)
        self._write_log(line)

    def close(self) -> None:
        """End the live line. Harmless when there is none."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _begin(self, event: Mapping[str, Any]) -> None:
        if not self._console.is_terminal:
            return
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[numbers]}"))
        self._live = Progress(*columns, console=self._console, transient=True)
        self._task = self._live.add_task("training", total=event["total"], completed=event["step"], numbers="")
        self._live.start()

    def _progress(self, event: Mapping[str, Any]) -> None:
        if self._live is not None:
            self._live.update(self._task, completed=event["step"], numbers=progress_line(event))
        if _tenths(event) == self._tenths:
            return
        self._tenths = _tenths(event)
        line = progress_line(event)
        if self._live is None:
            self._console.print(line, markup=False)
        self._write_log(line)

    def _evaluation(self, event: Mapping[str, Any]) -> None:
        """The live line counts evaluated views."""
        if self._live is not None:
            views, total = event["views"], event["total"]
            numbers = f"view {views}/{total}"
            self._live.update(self._task, description="evaluating", completed=views, total=total, numbers=numbers)

    def _write_log(self, line: str) -> None:
        """Append to log.txt, unless that is where stdout goes anyway. A log that cannot be written stops nothing."""
        try:
            if self._log is None:
                self._log = open(  # noqa: SIM115 (open as long as the run)
                    self._run / "log.txt", "a", encoding="utf-8", errors="backslashreplace"
                )
            if not _is_stdout(self._log):
                self._log.write(line + "\n")
                self._log.flush()
        except OSError:
            return


def started_line(event: Mapping[str, Any], run: Path) -> str:
    """Returns the first line of a run: backend, views and first Gaussians."""
    views = f"{event['train_views']} input view{'s' * (event['train_views'] != 1)}"
    views += f", {event['test_views']} held out" if event["test_views"] else ", none held out"
    few = " (few: regularizers on)" if event["sparse"] else ""
    if mirrors := event["mirrors"]:
        few += f", symmetric: every view counts once more behind {mirrors} mirror{'s' * (mirrors != 1)}"
    if turns := event.get("turns"):
        few += f", the same after every of {turns + 1} turns about an axis: every view counts from {turns} more sides"
    if guessed := event.get("guessed"):
        few += f", one photo: {guessed} guessed views of the body it suggests"
    begin = f"resumed at step {event['step']}" if event["step"] else f"init {event['init']}"
    return f"backend {event['backend']} | {views}{few} | {begin} | {event['n']:,} Gaussians | {run}"


def estimate_line(expected: Mapping[str, Any]) -> str:
    """Returns what the run will take, as far as that is known."""
    time = f", {clock(expected['cpu_seconds'])} of one core" if "cpu_seconds" in expected else ""
    return f"estimate: about {expected['memory_mb'] / 1000:.1f} GB of memory{time}"


def progress_line(event: Mapping[str, Any]) -> str:
    """Returns step, loss, PSNR of the input views, N, speed and time left."""
    psnr = "" if event["psnr"] is None else f"  PSNR {event['psnr']:.2f} dB"
    eta = "" if event["eta_seconds"] is None else f"  ETA {clock(event['eta_seconds'])}"
    return (
        f"step {event['step']}/{event['total']}  loss {event['loss']:.4f}{psnr}  N {event['n']:,}"
        f"  {event['steps_per_second']:.1f} steps/s{eta}"
    )


def clock(seconds: float) -> str:
    """h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _tenths(event: Mapping[str, Any]) -> int:
    return int(event["step"] / event["total"] / PLAIN_SHARE + 1e-9)


def _is_stdout(log: TextIO) -> bool:
    """True when stdout is redirected to this very file."""
    try:
        mine, theirs = os.fstat(log.fileno()), os.fstat(sys.stdout.fileno())
    except (OSError, ValueError):
        return False
    return (mine.st_dev, mine.st_ino) == (theirs.st_dev, theirs.st_ino)
