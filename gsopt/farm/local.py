"""A farm on this machine: processes under threads of the driver, as many at a time as cores and memory allow."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager

from gsopt.errors import InputError, UsageError
from gsopt.events import Report
from gsopt.farm.job import Job, Outcome, keep_result, make_room, partial_of, relocated
from gsopt.farm.worker import Worker


class LocalFarm:
    """`cpus` cores, and `memory` bytes where given, shared among the jobs that run at once."""

    def __init__(self, cpus: int, memory: int | None = None) -> None:
        self.cpus, self.memory = cpus, memory
        self._free, self._free_memory = cpus, memory or 0
        self._changed = threading.Condition()
        self._idle: list[Worker] = []
        self._canceled: set[str] = set()
        self._closed = False

    def __str__(self) -> str:
        return f"this machine, {self.cpus} core{'s' * (self.cpus != 1)}"

    def run(self, jobs: Iterable[Job], report: Report | None = None) -> Iterator[Outcome]:
        """See `Farm.run`."""
        todo = list(jobs)
        self._check(todo)
        self._canceled.clear()
        self._closed = False
        pool = ThreadPoolExecutor(self.cpus)
        try:
            yield from (done.result() for done in as_completed([pool.submit(self._do, job, report) for job in todo]))
        finally:
            self._closed = True
            with self._changed:
                self._changed.notify_all()
            pool.shutdown(cancel_futures=True)
            for worker in self._idle:
                worker.end()
            self._idle.clear()

    def cancel(self, name: str) -> None:
        """See `Farm.cancel`."""
        with self._changed:
            self._canceled.add(name)
            self._changed.notify_all()

    def _check(self, jobs: list[Job]) -> None:
        for job in jobs:
            if job.cpus > self.cpus or (self.memory is not None and (job.memory or 0) > self.memory):
                needs, has = (
                    f"{cpus} cores" + (f" and {memory / 1e9:.1f} GB" if memory else "")
                    for cpus, memory in ((job.cpus, job.memory), (self.cpus, self.memory))
                )
                raise UsageError(f"{job.name} needs {needs}, the farm has {has}. Lower --threads, or add machines.")

    def _do(self, job: Job, report: Report | None) -> Outcome:
        with self._room(job) as worker:
            if self._is_canceled(job):
                return Outcome(job, "canceled", error="It was canceled.")
            if report:
                report(f"{job.name}: started")
            try:
                make_room(job)
            except InputError as error:
                return Outcome(job, "failed", error=str(error))
            partial = partial_of(job.folder, str(os.getpid())) if job.folder else None
            places = {job.folder: partial} if job.folder and partial else {}
            outcome = worker.do(job, relocated(job.request, places), lambda: self._is_canceled(job))
        return keep_result(outcome, partial) if partial else outcome

    def _is_canceled(self, job: Job) -> bool:
        return self._closed or job.name in self._canceled

    @contextmanager
    def _room(self, job: Job) -> Iterator[Worker]:
        """Waits for free cores and memory, and lends a worker, one that has done such a job where there is one."""
        with self._changed:
            self._changed.wait_for(lambda: self._fits(job) or self._is_canceled(job))
            self._free -= job.cpus
            self._free_memory -= job.memory or 0
            worker = next((worker for worker in self._idle if worker.fits(job)), None) or next(
                iter(self._idle), Worker()
            )
            if worker in self._idle:
                self._idle.remove(worker)
        try:
            yield worker
        finally:
            with self._changed:
                self._idle.append(worker)
                self._free += job.cpus
                self._free_memory += job.memory or 0
                self._changed.notify_all()

    def _fits(self, job: Job) -> bool:
        return job.cpus <= self._free and (self.memory is None or (job.memory or 0) <= self._free_memory)
