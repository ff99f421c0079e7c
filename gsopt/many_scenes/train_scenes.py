"""Has a farm train on every scene, keeps one record of them all, and draws the page after each."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsopt.errors import InputError
from gsopt.events import Report, to_json, write_atomic
from gsopt.farm.job import Farm, Job, Outcome
from gsopt.farm.worker import serving
from gsopt.many_scenes.page import write_page
from gsopt.many_scenes.scenes import SceneRun
from gsopt.raster.cpu_backend import ISA_VARIABLE, workspace
from gsopt.results.evaluation import read_metrics

RECORDS, PAGE, PICTURE = "scenes.json", "index.html", "picture.webp"
FIGURES = ("psnr", "ssim", "lpips_alex")
VERSION = 1
SPARING = 20.0
"""Time between two writings of the records, in durations of one."""


@dataclass(frozen=True)
class Limits:
    """Bounds of every run."""

    threads: int = 1
    memory: int | None = None
    seconds: float = 86_400.0


class Sparingly:
    """Calls a function in at most a twentieth of the time: the records of 10,000 scenes take longer to write than a
    farm takes for the next one. A run whose record was lost with the driver is evaluated again, not trained."""

    def __init__(self, function: Callable[[], None]) -> None:
        self._function, self._next = function, 0.0

    def __call__(self) -> None:
        began = time.monotonic()
        if began >= self._next:
            self._function()
            self._next = began + SPARING * (time.monotonic() - began)


def train_scenes(
    scenes: Sequence[SceneRun], out: Path, farm: Farm, limits: Limits, report: Report
) -> list[dict[str, Any]]:
    """Trains on the scenes that `out` has no finished run of, and returns the record of each: `state` done or failed.

    A run that was begun goes on at its checkpoint. Raises InputError for an `out` that holds something else.
    """
    records = _opened(out)
    todo = {scene.name: scene for scene in scenes if not _is_done(records.get(scene.name), scene, out)}
    report(f"{len(scenes)} scenes, {len(scenes) - len(todo)} of them finished before; {farm}")
    names = [scene.name for scene in scenes]
    jobs = [_job(scene, out, limits) for scene in todo.values()]
    _write(out, records, names)
    write = Sparingly(lambda: _write(out, records, names))
    try:
        for number, outcome in enumerate(farm.run(jobs), 1):
            scene = todo[outcome.job.name]
            records[scene.name] = _record(scene, outcome, out)
            write()
            report(f"{number}/{len(jobs)} {_line(records[scene.name])}")
    finally:
        _write(out, records, names)
    return [records[name] for name in names]


def _opened(out: Path) -> dict[str, dict[str, Any]]:
    """The records of an earlier call by name. Makes the folder."""
    path = out / RECORDS
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(out.iterdir()):
                raise InputError(f"{out} is not empty and holds no {RECORDS}. Choose another -o.")
            return {}
        document = json.loads(path.read_bytes())
        if document["version"] != VERSION:
            raise InputError(f"{path} has version {document['version']}, got to be {VERSION}. Choose another -o.")
        return {str(row["name"]): dict(row) for row in document["scenes"]}
    except OSError as error:
        raise InputError(f"Cannot use {out}: {error.strerror}. Choose another -o.") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is broken: {error!r}. Restore it, or choose another -o.") from error


def _is_done(record: dict[str, Any] | None, scene: SceneRun, out: Path) -> bool:
    same = record is not None and record.get("data") == str(scene.data) and record.get("flags") == list(scene.flags)
    return same and record is not None and record.get("state") == "done" and (out / scene.name / "splat.ply").is_file()


def _job(scene: SceneRun, out: Path, limits: Limits) -> Job:
    run = (out / scene.name).absolute()
    words = ["train", str(scene.data), "-m", str(run), *scene.flags, "--threads", str(limits.threads)]
    words += ["--resume"] if (run / "config.json").is_file() else []
    return Job(
        scene.name,
        serving("gsopt.cli.serve_jobs"),
        {"arguments": words, "picture_of": str(run), "picture": str(run / PICTURE)},
        inputs=(scene.data,),
        writes=(out.absolute(),),
        cpus=limits.threads,
        memory=limits.memory,
        seconds=limits.seconds,
        fresh=True,
        environment={ISA_VARIABLE: workspace(1).isa},
    )


def _record(scene: SceneRun, outcome: Outcome, out: Path) -> dict[str, Any]:
    record: dict[str, Any] = {**asdict(scene), "data": str(scene.data), "flags": list(scene.flags)}
    record |= {"host": outcome.host, "isa": outcome.job.environment[ISA_VARIABLE], "threads": outcome.job.cpus}
    record |= {"seconds": round(outcome.seconds, 1), "peak_memory": outcome.peak_memory}
    if outcome.ending != "done":
        return {**record, "state": "failed", "reason": outcome.error}
    if outcome.answer:
        return {**record, "state": "failed", "reason": _last_words(outcome)}
    metrics = read_metrics(out / scene.name)
    if "n_gaussians" not in metrics:
        return {**record, "state": "failed", "reason": "It was stopped. The same command goes on with it."}
    held_out = metrics.get("mean") is not None
    mean = (metrics if held_out else metrics["train"])["mean"]
    figures = {name: mean.get(name) for name in FIGURES}
    return {**record, "state": "done", "held_out": held_out, "n_gaussians": metrics["n_gaussians"], **figures}


def _last_words(outcome: Outcome) -> str:
    """The error that `gsopt train` printed last."""
    lines = [line for line in outcome.output.splitlines() if line.startswith("gsopt: ") and ": warning: " not in line]
    return lines[-1].removeprefix("gsopt: ") if lines else f"It ended with exit code {outcome.answer}."


def _line(record: dict[str, Any]) -> str:
    if record["state"] != "done":
        return f"{record['name']} failed: {record['reason']}"
    views = "held-out views" if record["held_out"] else "input views"
    return f"{record['name']}: {record['psnr']:.2f} dB over {views}, {record['seconds']:.0f} s on {record['host']}"


def _write(out: Path, records: dict[str, dict[str, Any]], names: Sequence[str]) -> None:
    """Writes records and page; scenes of earlier calls that this one does not name stay at the end."""
    order = [*names, *(name for name in records if name not in set(names))]
    rows = [records[name] for name in order if name in records]
    write_atomic(out / RECORDS, to_json({"version": VERSION, "scenes": rows}))
    write_page(rows, len(order), out / PAGE, PICTURE)
