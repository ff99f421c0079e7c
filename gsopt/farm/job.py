"""The protocol of a farm: jobs go in, an outcome comes back for every one, whatever happens to it."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol

from gsopt.errors import InputError
from gsopt.events import Report

Ending = Literal["done", "failed", "late", "memory", "died", "canceled"]
PARTIAL = ".partial-"
"""Prefix of a result that is being written."""


@dataclass(frozen=True)
class Job:
    """One request to a worker process."""

    name: str
    """Unique among the jobs of a call."""
    command: tuple[str, ...]
    """Starts a worker: a program that calls `gsopt.farm.serve.serve`."""
    request: Mapping[str, Any]
    """JSON-ready. Paths at and below `inputs` and `folder` are replaced on a machine without the driver's disk."""
    folder: Path | None = None
    """New folder that the worker makes; it appears whole or not at all. A job without is done by its answer."""
    inputs: tuple[Path, ...] = ()
    """Files and folders that the job reads."""
    writes: tuple[Path, ...] = ()
    """Folders that the job writes in place, and that its machine must therefore see."""
    cpus: int = 1
    memory: int | None = None
    """Bytes that the worker and its children may hold; ended beyond."""
    seconds: float = 86_400.0
    """Ended when it takes longer."""
    fresh: bool = False
    """Ends the worker after the job, so that the next one gets a new process."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Set for the worker, such as the instruction set that the bits depend on."""


@dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    job: Job
    ending: Ending
    answer: Any = None
    """The worker's answer when done, else None."""
    error: str = ""
    """Reason for no answer, one sentence."""
    output: str = ""
    """End of what the worker printed."""
    host: str = ""
    seconds: float = 0.0
    peak_memory: int = 0
    """Most bytes seen, 0 where the system does not report them."""


class Farm(Protocol):
    """Workers on this machine or on many."""

    def run(self, jobs: Iterable[Job], report: Report | None = None) -> Iterator[Outcome]:
        """Outcomes as they come; closing the iterator ends all jobs. `report` receives a line when a job starts.

        Raises UsageError for a job that is larger than the farm.
        """
        ...

    def cancel(self, name: str) -> None:
        """Ends a job that waits or runs; its outcome is `canceled`."""
        ...

    def __str__(self) -> str:
        """Names the farm in one line for people and records."""
        ...


def partial_of(folder: Path, token: str) -> Path:
    """Sibling of a result's folder that one attempt writes."""
    return folder.with_name(f"{PARTIAL}{token}-{folder.name}")


def relocated(value: Any, places: Mapping[Path, Path]) -> Any:
    """A JSON-ready value with every path at or below a key of `places` moved there."""
    if isinstance(value, Mapping):
        return {key: relocated(item, places) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [relocated(item, places) for item in value]
    if not isinstance(value, str):
        return value
    for old, new in places.items():
        if value == str(old) or value.startswith(f"{old}/"):
            return f"{new}{value[len(str(old)) :]}"
    return value


def keep_result(outcome: Outcome, partial: Path) -> Outcome:
    """Renames the partial folder of a finished job to its name and removes that of any other."""
    job = outcome.job
    if job.folder is None:
        return outcome
    if outcome.ending == "done":
        try:
            partial.rename(job.folder)
            return outcome
        except OSError as error:
            message = f"Its result cannot be renamed to {job.folder}: {error.strerror}."
            outcome = Outcome(job, "failed", None, message, outcome.output, outcome.host, outcome.seconds)
    shutil.rmtree(partial, ignore_errors=True)
    return outcome


def make_room(job: Job) -> None:
    """Makes the place of a job's result. Raises InputError where that cannot be, or where something is already."""
    if job.folder is None:
        return
    if job.folder.exists() or job.folder.is_symlink():
        raise InputError(f"The output folder must be new, but {job.folder} exists. Remove it or choose another.")
    try:
        job.folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make {job.folder.parent}: {error.strerror}. Choose another folder.") from error
