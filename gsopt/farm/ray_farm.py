"""A farm on a Ray cluster: a task per job, in a worker process of the node that takes it. Only this module knows Ray.

Ray repeats a task whose node or worker process died. A node that sees the driver's disk reads and writes there; to any
other, inputs are sent through Ray's object store, and results come back the same way.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import socket
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsopt._optional import require
from gsopt._version import __version__
from gsopt.errors import GsoptError, InputError, UsageError
from gsopt.events import Report
from gsopt.farm.job import Job, Outcome, keep_result, make_room, partial_of, relocated
from gsopt.farm.transfer import packed, received, scratch, stamp, unpacked
from gsopt.farm.worker import Worker

CONNECT_SECONDS = 10.0
MAX_RETRIES = 2
"""Repetitions of a job whose node or worker process died."""
WINDOW = 2000
"""Tasks that Ray holds at a time."""
_WARM: list[Worker] = []
"""Worker of this process of a node, kept for its next job."""


class RayFarm:
    """The cluster at `address`: HOST:PORT of its client server, or empty for the one that this machine is part of."""

    def __init__(self, address: str = "", transfer: bool = False) -> None:
        """`transfer`: send inputs and results even to nodes that see the driver's disk."""
        self.address, self.transfer = address, transfer
        self._ray: Any = require("ray", "ray", "`--farm ray`")
        self._canceled: set[str] = set()
        self._sent: dict[Path, Any] = {}
        self._own = not self._ray.is_initialized()
        if self._own:
            self._connect()
        self._perform = self._ray.remote(max_retries=MAX_RETRIES)(perform)  # once: Ray keeps workers per function

    def __str__(self) -> str:
        nodes = [node["Resources"].get("CPU", 0) for node in self._nodes()]
        return f"Ray {self._ray.__version__}, {len(nodes)} nodes, {sum(nodes):.0f} cores"

    def run(self, jobs: Iterable[Job], report: Report | None = None) -> Iterator[Outcome]:
        """See `Farm.run`."""
        todo = list(jobs)
        self._check(todo)
        self._canceled.clear()
        waiting, running = todo[::-1], dict[Any, Job]()
        marks = _mark({path for job in todo for path in _written(job)})
        try:
            while waiting or running:
                while waiting and len(running) < WINDOW:
                    job = waiting.pop()
                    if outcome := self._refusal(job):
                        yield outcome
                    else:
                        running[self._submit(job, marks, {})] = job
                ready, _ = self._ray.wait(list(running), timeout=1.0)
                for task in ready:
                    job = running.pop(task)
                    reply = self._reply(task)
                    if missing := reply.get("missing"):
                        running[self._submit(job, marks, {path: self._send(Path(path)) for path in missing})] = job
                    else:
                        yield self._delivered(job, reply)
                self._cancel_tasks(running)
        finally:
            for task in running:
                self._ray.cancel(task, force=True)
            for mark in marks.values():
                Path(mark).unlink(missing_ok=True)

    def cancel(self, name: str) -> None:
        """See `Farm.cancel`."""
        self._canceled.add(name)

    def close(self) -> None:
        """Leaves the cluster."""
        if self._own:
            self._ray.shutdown()

    def _connect(self) -> None:
        host, _, port = self.address.rpartition(":")
        try:
            if self.address:
                socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
            target = f"ray://{self.address}" if self.address else "auto"
            self._ray.init(address=target, log_to_driver=False, logging_level="ERROR")
        except (OSError, ConnectionError) as error:
            where = f"at {self.address}" if self.address else "on this machine"
            advice = "Check host and port (10001 unless `ray start` had --ray-client-server-port)."
            remedy = advice if self.address else "Start one with `ray start --head`, or give --farm ray://HOST:10001."
            raise InputError(f"No Ray cluster answers {where}: {error}. {remedy}") from error
        except RuntimeError as error:
            first = " ".join(str(error).split())[:300]
            raise InputError(
                f"The Ray cluster refused this driver, which has Ray {self._ray.__version__}: {first}. "
                "Install the same versions of Ray and Python on all machines."
            ) from error

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def _check(self, jobs: list[Job]) -> None:
        most = max((int(node["Resources"].get("CPU", 0)) for node in self._nodes()), default=0)
        for job in jobs:
            if job.cpus > most:
                raise UsageError(f"{job.name} needs {job.cpus} cores, the largest node has {most}. Lower --threads.")

    def _refusal(self, job: Job) -> Outcome | None:
        """The outcome of a job that cannot be submitted."""
        try:
            make_room(job)
        except InputError as error:
            return Outcome(job, "failed", error=str(error))
        return Outcome(job, "canceled", error="It was canceled.") if job.name in self._canceled else None

    def _submit(self, job: Job, marks: Mapping[str, str], sent: Mapping[str, Any]) -> Any:
        spec = {**asdict(job), "folder": None if job.folder is None else str(job.folder)}
        spec |= {"inputs": [], "stamps": {str(path): stamp(path) for path in job.inputs}}
        spec |= {"writes": [str(path) for path in job.writes], "transfer": self.transfer, "gsopt": __version__}
        memory = {} if job.memory is None else {"memory": job.memory}
        task = self._perform.options(num_cpus=job.cpus, **memory)
        return task.remote(spec, marks, dict(sent))

    def _send(self, path: Path) -> Any:
        """The input in the object store, put there once."""
        if path not in self._sent:
            self._sent[path] = self._ray.put(packed(path))
        return self._sent[path]

    def _reply(self, task: Any) -> dict[str, Any]:
        errors = self._ray.exceptions
        try:
            return dict(self._ray.get(task))
        except errors.TaskCancelledError:
            return {"ending": "canceled", "error": "It was canceled."}
        except errors.RayTaskError as error:
            cause = " ".join(str(error.cause if hasattr(error, "cause") else error).split())[-400:]
            return {"ending": "failed", "error": f"Its node could not take it: {cause}. Install the same gsopt there."}
        except errors.RayError as error:
            lost = " ".join(str(error).split())[:300]
            return {"ending": "died", "error": f"Its node or worker process died {MAX_RETRIES + 1} times: {lost}"}

    def _delivered(self, job: Job, reply: dict[str, Any]) -> Outcome:
        """The outcome of a reply, its result in place."""
        content, partial = reply.pop("content", None), reply.pop("partial", None)
        outcome = Outcome(job, **reply)
        if job.name in self._canceled and outcome.ending != "done":
            outcome = Outcome(job, "canceled", error="It was canceled.")
        if job.folder is None:
            return outcome
        place = Path(partial) if partial else partial_of(job.folder, secrets.token_hex(4))
        if content is not None:
            try:
                unpacked(content, place)
            except OSError as error:
                outcome = Outcome(job, "failed", error=f"Its result cannot be written: {error.strerror}.")
        outcome = keep_result(outcome, place)
        for stale in job.folder.parent.glob(partial_of(job.folder, "*").name.replace("[", "[[]")):
            shutil.rmtree(stale, ignore_errors=True)  # of a node that died
        return outcome

    def _cancel_tasks(self, running: Mapping[Any, Job]) -> None:
        for task, job in running.items():
            if job.name in self._canceled:
                self._ray.cancel(task, force=True)


def _written(job: Job) -> list[Path]:
    """Folders where every machine must, or may, write."""
    return [*job.writes, *([job.folder.parent] if job.folder else [])]


def _mark(folders: set[Path]) -> dict[str, str]:
    """A file in every folder that the driver writes to: a node that sees it shares the disk."""
    marks = {}
    for folder in folders:
        mark = folder / f".farm-{os.getpid()}-{secrets.token_hex(8)}"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            mark.touch()
        marks[str(folder)] = str(mark)
    return marks


def perform(spec: dict[str, Any], marks: dict[str, str], sent: dict[str, Any]) -> dict[str, Any]:
    """Does a job on a node: its outcome, or the inputs that must be sent first."""
    import ray

    host = socket.gethostname()
    if spec["gsopt"] != __version__:
        versions = f"gsopt {__version__}, the driver {spec['gsopt']}"
        return {"ending": "failed", "error": f"{host} has {versions}. Install the same one.", "host": host}
    for folder in spec["writes"]:
        if not Path(marks[folder]).exists():
            return {"ending": "failed", "error": f"{host} does not see {folder}. Choose a shared disk.", "host": host}
    places: dict[Path, Path] = {}
    missing = [path for path, seen in spec["stamps"].items() if spec["transfer"] or stamp(Path(path)) != seen]
    if any(path not in sent for path in missing):
        return {"missing": missing}
    try:
        for path in missing:
            places[Path(path)] = received(Path(path).name, ray.get(sent[path]))
        return _done(spec, marks, places)
    except GsoptError as error:
        return {"ending": "failed", "error": str(error), "host": host}
    except OSError as error:
        return {"ending": "failed", "error": f"{host}: {error.strerror or error}.", "host": host}


def _done(spec: dict[str, Any], marks: dict[str, str], places: dict[Path, Path]) -> dict[str, Any]:
    """The reply about a job whose inputs are at hand; its result is in a shared folder, or in the reply."""
    folder = None if spec["folder"] is None else Path(spec["folder"])
    shared = folder is not None and not spec["transfer"] and Path(marks[str(folder.parent)]).exists()
    partial = None
    if folder is not None:
        token = secrets.token_hex(4)
        partial = partial_of(folder if shared else scratch() / folder.name, token)
        places = {**places, folder: partial}
    command = tuple(relocated(list(spec["command"]), places))
    if not Path(command[0]).exists():
        command = (sys.executable, *command[1:])
    fields = {key: spec[key] for key in ("name", "cpus", "memory", "seconds", "fresh", "environment")}
    job = Job(command=command, request=relocated(spec["request"], places), **fields)
    outcome = _worker(job).do(job, job.request)
    reply = {key: value for key, value in vars(outcome).items() if key != "job"}
    if partial is not None and shared:
        reply["partial"] = str(partial)
    elif partial is not None:
        reply["content"] = packed(partial) if outcome.ending == "done" else None
        shutil.rmtree(partial, ignore_errors=True)
    return reply


def _worker(job: Job) -> Worker:
    """The worker of this process: Ray gives it one job at a time."""
    if not _WARM:
        _WARM.append(Worker())
    return _WARM[0]
