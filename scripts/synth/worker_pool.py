"""Worker processes: each holds one Blender and renders one object at a time. A worker that dies takes nothing along.

A worker reads a job a line from its standard input and answers a line on its standard output; whatever Blender prints
goes to the log. It ends by itself when the run that started it is gone.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import queue
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from gsopt.errors import GsoptError
from synth.mesh_items import Item
from synth.settings import Settings

ANSWER = "synth_views answers "
SCRIPT = Path(__file__).resolve().parent.parent / "synth_views.py"


@dataclass(frozen=True)
class Job:
    """One object to render into the new folder `out`."""

    item: Item
    settings: Settings
    seed: int
    out: Path


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job: seconds of each stage, or why there is no object."""

    job: Job
    seconds: dict[str, float] | None = None
    error: str | None = None


class Worker:
    """The near end of one worker process, started when it is first needed and again after it died."""

    def __init__(self, log: IO[bytes], time_limit: float) -> None:
        self.log, self.time_limit = log, time_limit
        self.process: subprocess.Popen[str] | None = None

    def do(self, job: Job) -> Outcome:
        """Have the job done. A worker that crashes or exceeds the time limit is an error of this job only."""
        if self.process is None or self.process.poll() is not None:
            self.process = subprocess.Popen(
                worker_command(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self.log,
                text=True,
                encoding="utf-8",
                errors="replace",
            )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        late = threading.Event()
        timer = threading.Timer(self.time_limit, lambda: (late.set(), self.end()))
        timer.start()
        try:
            self.process.stdin.write(to_json(job) + "\n")
            self.process.stdin.flush()
            for line in self.process.stdout:
                if line.startswith(ANSWER):
                    return Outcome(job, **json.loads(line[len(ANSWER) :]))
        except BrokenPipeError:
            pass
        finally:
            timer.cancel()
            timer.join()  # else the next job could go to a process that is about to be killed
        if late.is_set():
            return Outcome(job, error=f"It took longer than {self.time_limit:g} s. Simplify it, or raise --time-limit.")
        code = self.process.wait()
        return Outcome(job, error=f"Blender crashed on it (exit code {code}). log.txt has its last words.")

    def end(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def run_jobs(jobs: Iterable[Job], workers: int, log: IO[bytes], time_limit: float) -> Iterator[Outcome]:
    """Outcomes as they come, from `workers` processes. Closing the iterator ends the workers."""
    idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
    crew = [Worker(log, time_limit) for _ in range(workers)]
    for worker in crew:
        idle.put(worker)

    def do(job: Job) -> Outcome:
        worker = idle.get()
        try:
            return worker.do(job)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(workers)
    try:
        yield from (done.result() for done in as_completed([pool.submit(do, job) for job in jobs]))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in crew:
            worker.end()


def worker_command() -> list[str]:
    """This interpreter with the bpy wheel; inside Blender, another Blender in the background."""
    bpy = sys.modules.get("bpy")
    if bpy is not None and bpy.app.binary_path:
        blender = [bpy.app.binary_path, "--background", "--factory-startup", "--python", str(SCRIPT)]
        return [*blender, "--", "--worker"]
    return [sys.executable, str(SCRIPT), "--worker"]


def to_json(job: Job) -> str:
    return json.dumps(dataclasses.asdict(job), default=str)


def from_json(line: str) -> Job:
    """The job that `to_json` wrote; lists become tuples again."""
    values = json.loads(line)

    def restore(fields: dict[str, Any]) -> dict[str, Any]:
        return {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}

    item = Item(**restore(values["item"]) | {"mesh": Path(values["item"]["mesh"])})
    return Job(item, Settings(**restore(values["settings"])), values["seed"], Path(values["out"]))


def serve() -> None:
    """Be a worker: never returns."""
    from synth.render_object import render_object

    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    threading.Thread(target=receive, args=(jobs,), daemon=True).start()
    while True:
        job = jobs.get()
        try:
            timing = render_object(job.item.mesh, job.settings, job.seed, job.out, job.item)
            answer: dict[str, Any] = {"seconds": dataclasses.asdict(timing)}
        except GsoptError as error:
            answer = {"error": str(error)}
        except Exception as error:  # a defect of ours or of Blender's: told, logged, and the run goes on
            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {error}. log.txt has the traceback; please report it."}
        print(ANSWER + json.dumps(answer), file=answers, flush=True)


def receive(jobs: queue.SimpleQueue[Job]) -> None:
    """Take in jobs until the run closes the pipe or is gone; then end, in the middle of an object if need be."""
    with contextlib.suppress(ValueError):
        for line in sys.stdin:
            jobs.put(from_json(line))
    os._exit(0)
