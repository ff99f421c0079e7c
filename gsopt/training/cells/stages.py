"""The runs that a scene in cells consists of: their settings, and their jobs on a farm."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsopt import check
from gsopt.config.cells import CellConfig
from gsopt.config.train import TrainConfig
from gsopt.data import files
from gsopt.errors import InputError
from gsopt.farm.job import Farm, Job, Outcome
from gsopt.farm.worker import serving
from gsopt.raster.cpu_backend import ISA_VARIABLE, workspace
from gsopt.training.cells.plan import Cell
from gsopt.training.interrupt import StopRequest
from gsopt.training.open_settings import MANY
from gsopt.training.run_directory import RunDirectory

COARSE_SHARE, CELL_SHARE, POLISH_SHARE = 0.3, 0.8, 0.3
"""Steps of the coarse run, of a cell that all views see, and of the polish, over those of one run."""
LONGEST = 30 * 86_400.0
"""Seconds that a run may take."""
POLL_SECONDS = 0.2
START, FROZEN = "start.ply", "frozen.ply"


@dataclass(frozen=True)
class Stage:
    """One ordinary run."""

    name: str
    """Its folder below RUN."""
    config: TrainConfig


def coarse_stage(config: TrainConfig, count: int, max_gaussians: int) -> Stage:
    """The whole scene with the Gaussians of one cell: it needs no more memory than that."""
    return Stage("coarse", _changed(config, COARSE_SHARE, math.ceil(max_gaussians / count)))


def cell_stage(config: TrainConfig, cell: Cell, views: int, run: Path) -> Stage:
    """A cell that goes on from its part of the coarse model, at once at the full resolution and with all bands. Without
    a reset of opacities, which would uncover what lies behind the cell."""
    name = f"cells/{cell.name}"
    whole = _changed(config, CELL_SHARE * len(cell.views) / views, cell.max_gaussians)
    part = CellConfig(str(run / name / START), str(run / name / FROZEN), cell.views)
    density = replace(whole.density, refine_start=0, reset_every=0)
    return Stage(name, _continued(replace(whole, cell=part, density=density)))


def polish_stage(config: TrainConfig, gaussians: int, run: Path) -> Stage:
    """All Gaussians together; none is added or removed."""
    whole = _changed(config, POLISH_SHARE, gaussians)
    density = replace(whole.density, refine_stop=0, reset_every=0)
    cell = CellConfig(start=str(run / "polish" / START))
    return Stage("polish", _continued(replace(whole, cell=cell, density=density)))


def _changed(config: TrainConfig, share: float, max_gaussians: int) -> TrainConfig:
    """The same with a share of the steps, those before the first Gaussians are added too, and so many at most."""
    steps = max(1, math.ceil(share * config.iterations))
    start = math.ceil(share * MANY.growth(config.density)["refine_start"])
    density = replace(config.density, max_gaussians=max_gaussians, refine_start=start)
    every = max(1, math.ceil(share * MANY.of(config.optimizer)["sh_degree_every"]))
    optimizer = replace(config.optimizer, sh_degree_every=every)
    return replace(config.with_steps(steps), cells="", density=density, optimizer=optimizer)


def _continued(config: TrainConfig) -> TrainConfig:
    """The same for Gaussians that have learned already."""
    schedule = replace(config.schedule, coarse_until=())
    return replace(config, schedule=schedule, optimizer=replace(config.optimizer, sh_degree_every=1))


class Stages:
    """Has a farm do stages and records in config.json which are done; the others go on at their checkpoints."""

    def __init__(self, directory: RunDirectory, farm: Farm, stop: StopRequest, threads: int) -> None:
        self._directory, self._farm, self._stop, self._threads = directory, farm, stop, threads
        recorded = directory.recorded("stages") or {}
        if not isinstance(recorded, dict) or not all(isinstance(facts, dict) for facts in recorded.values()):
            raise InputError(f"`stages` in {directory.path / 'config.json'} is garbled. Restore the file.")
        self._records: dict[str, dict[str, Any]] = recorded

    def run(self, stages: Sequence[Stage]) -> None:
        """Does what is not done yet. Raises Stopped on request, InputError for the first stage that failed."""
        todo = {stage.name: stage for stage in stages if not self._is_done(stage.name)}
        failures: list[str] = []
        self._stop.check()
        with self._passing_on_stops(list(todo)):
            for outcome in self._farm.run([self._job(stage) for stage in todo.values()]):
                if outcome.ending != "done":
                    failures.append(f"{outcome.job.name} failed: {outcome.error}")
                elif not outcome.answer.get("stopped"):
                    self._record(outcome)
        self._stop.check()
        if failures:
            raise InputError(f"A part of the run failed. {min(failures)} The same command goes on with the rest.")

    def total(self, fact: str) -> float:
        """The sum of a figure over all stages."""
        return sum(self._facts(fact))

    def most(self, fact: str) -> float | None:
        """The largest figure of any stage."""
        return max(self._facts(fact), default=None)

    def _facts(self, fact: str) -> Iterator[float]:
        where = f"`stages` in {self._directory.path / 'config.json'}"
        values = (facts.get(fact) for facts in self._records.values())
        return (files.number(value, where) for value in values if value is not None)

    def _is_done(self, name: str) -> bool:
        return name in self._records and (self._directory.path / name / "splat.ply").is_file()

    def _job(self, stage: Stage) -> Job:
        run, config = (self._directory.path / stage.name).absolute(), replace(stage.config, threads=self._threads)
        memory = check.byte_count("--max-memory", config.max_memory) if config.max_memory else None
        return Job(
            stage.name,
            serving("gsopt.training.cells.worker"),
            {"config": config.to_dict(), "run": str(run), "stop": str(self._directory.stop_file.absolute())},
            inputs=(Path(config.data.path),),
            writes=(self._directory.path.absolute(),),
            cpus=self._threads,
            memory=memory,
            seconds=LONGEST,
            fresh=True,
            environment={ISA_VARIABLE: workspace(1).isa},
        )

    def _record(self, outcome: Outcome) -> None:
        name, facts = outcome.job.name, dict(outcome.answer)
        self._records[name] = {**facts, "host": outcome.host}
        self._directory.record(stages=dict(sorted(self._records.items())))
        self._directory.emit("cells", message=_line(name, facts), stage=name, n=facts["n"], steps=facts["steps"])

    @contextlib.contextmanager
    def _passing_on_stops(self, names: Sequence[str]) -> Iterator[None]:
        """A request to stop reaches every run that is under way."""
        over = threading.Event()

        def look() -> None:
            while not over.wait(POLL_SECONDS):
                if self._stop:
                    for place in (self._directory.path, *(self._directory.path / name for name in names)):
                        with contextlib.suppress(OSError):  # a run that has not begun has no folder
                            (place / "stop").touch()

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def _line(name: str, facts: Mapping[str, Any]) -> str:
    peak = "" if facts["peak_memory_mb"] is None else f", peak memory {facts['peak_memory_mb']:.0f} MB"
    return f"{name} is done: {facts['n']:,} Gaussians, {facts['steps']} steps, {facts['seconds']:.0f} s{peak}"
