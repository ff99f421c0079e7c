"""The near end of a worker process: starts it, gives it a job, and ends it at the job's bounds of time and memory."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gsopt.farm.job import Ending, Job, Outcome
from gsopt.farm.serve import ANSWER

POLL_SECONDS = 0.1
OUTPUT_BYTES = 1 << 16
"""End of a worker's output that an outcome holds."""
ERROR_LINES = 12
"""Last lines of the output of a worker that died, in its error."""


def serving(module: str) -> tuple[str, ...]:
    """The command of a worker that a module of gsopt is."""
    return (sys.executable, "-m", module)


class Worker:
    """One process, started for the first job and again after it died; keeps what it has loaded from job to job."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None
        self._kind: tuple[Any, ...] = ()
        self._output = tempfile.TemporaryFile()  # noqa: SIM115

    def fits(self, job: Job) -> bool:
        """True when the process that runs can take the job."""
        return self._alive() and self._kind == _kind(job)

    def do(self, job: Job, request: Any, canceled: Callable[[], bool] = lambda: False) -> Outcome:
        """Has `request` done, the job's with the paths of this machine. A failure is an outcome of this job only."""
        began, since = time.monotonic(), os.fstat(self._output.fileno()).st_size
        try:
            self._start(job)
        except OSError as refusal:
            return Outcome(job, "died", error=f"Cannot start {job.command[0]}: {refusal.strerror}.")
        assert self.process is not None
        with _watched(self.process, job, canceled) as watch:
            reply = self._reply(json.dumps(request))
        if job.fresh or watch.ending:
            self.end()
        output = self._printed(since)
        ending, answer, error = self._judge(job, reply, watch.ending, output)
        seconds = time.monotonic() - began
        return Outcome(job, ending, answer, error, output, platform.node(), seconds, watch.peak)

    def end(self) -> None:
        """Kills the process and its children."""
        if self.process is not None:
            kill(self.process)
            for pipe in (self.process.stdin, self.process.stdout):
                with contextlib.suppress(OSError):
                    pipe.close()  # type: ignore[union-attr]

    def _alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def _start(self, job: Job) -> None:
        if self.fits(job):
            return
        self.end()
        self._kind = _kind(job)
        self.process = subprocess.Popen(
            job.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._output,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "OMP_NUM_THREADS": str(job.cpus), **job.environment},
            start_new_session=True,
        )

    def _reply(self, line: str) -> dict[str, Any] | None:
        """The worker's answer, or None when it died first."""
        assert self.process is not None
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(BrokenPipeError, ValueError):
            self.process.stdin.write(line + "\n")
            self.process.stdin.flush()
            for found in self.process.stdout:
                if found.startswith(ANSWER):
                    return json.loads(found[len(ANSWER) :])
        return None

    def _judge(
        self, job: Job, reply: dict[str, Any] | None, ending: Ending | None, output: str
    ) -> tuple[Ending, Any, str]:
        assert self.process is not None
        if reply is not None and "answer" in reply:
            return "done", reply["answer"], ""
        if reply is not None:
            return "failed", None, str(reply.get("error"))
        if ending == "late":
            return "late", None, f"It took longer than {job.seconds:g} s."
        if ending == "memory":
            return "memory", None, f"It held more than {(job.memory or 0) / 1e6:.0f} MB of memory."
        if ending == "canceled":
            return "canceled", None, "It was canceled."
        last = " / ".join(output.splitlines()[-ERROR_LINES:])
        return "died", None, f"Its worker died (exit code {self.process.wait()}): {last}"

    def _printed(self, since: int) -> str:
        descriptor = self._output.fileno()
        size = os.fstat(descriptor).st_size
        start = max(since, size - OUTPUT_BYTES)
        return os.pread(descriptor, size - start, start).decode("utf-8", "replace")


class _Watch:
    """Observations of a running job."""

    def __init__(self) -> None:
        self.ending: Ending | None = None
        self.peak = 0


@contextlib.contextmanager
def _watched(process: subprocess.Popen[str], job: Job, canceled: Callable[[], bool]) -> Iterator[_Watch]:
    """Ends the process where it exceeds the bounds of the job, while the block waits for its answer."""
    watch, over, deadline = _Watch(), threading.Event(), time.monotonic() + job.seconds

    def look() -> None:
        while not over.wait(POLL_SECONDS):
            now = resident(process.pid)
            watch.peak = max(watch.peak, now)
            if job.memory is not None and now > job.memory:
                watch.ending = "memory"
            elif time.monotonic() > deadline:
                watch.ending = "late"
            elif canceled():
                watch.ending = "canceled"
            if watch.ending:
                return kill(process)

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield watch
    finally:
        over.set()
        thread.join()  # else the next job could go to a process that is about to be killed


def _kind(job: Job) -> tuple[Any, ...]:
    """Equal for jobs that one process can serve."""
    return job.command, job.cpus, tuple(sorted(job.environment.items()))


def kill(process: subprocess.Popen[str]) -> None:
    """Ends a process and its children, and waits for it."""
    below = list(tree(process.pid))
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg") and process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    for child in below[1:]:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(child, signal.SIGKILL)
    process.kill()
    process.wait()


def resident(pid: int) -> int:
    """Bytes of memory that a process and its children hold; 0 where the system does not report them."""
    total = 0
    for number in tree(pid):
        with contextlib.suppress(OSError, ValueError, IndexError):
            total += int(Path(f"/proc/{number}/statm").read_text(encoding="ascii").split()[1])
    return total * os.sysconf("SC_PAGE_SIZE") if total else 0


def tree(pid: int) -> Iterator[int]:
    """A process and all below it, as Linux reports them; elsewhere the process alone."""
    yield pid
    for task in Path(f"/proc/{pid}/task").glob("*"):
        with contextlib.suppress(OSError, ValueError):
            for child in (task / "children").read_text(encoding="ascii").split():
                yield from tree(int(child))
