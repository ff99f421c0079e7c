"""Runs command lines of gsopt on a faulty disk: one JSON job a line on stdin, its outcome on stdout.

Every job runs in a fork, so that torch is imported once. LD_PRELOAD names the compiled faulty_disk.c.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, NoReturn, Self

import torch

import gsopt.cli.train  # noqa: F401 (jobs would import it anew)
from gsopt.benchmark.suite import single_run
from gsopt.benchmark.suite.single_run import RunFailed
from gsopt.cli import main
from gsopt.config.train import InitConfig, SparseConfig, TrainConfig
from gsopt.data.sfm import child_process
from gsopt.errors import GsoptError
from gsopt.farm import open as open_farm
from gsopt.farm.job import Job, Outcome
from gsopt.finetune import evaluation, reconstruction_pairs
from gsopt.sds.priors import view_conditioned

FEW = TrainConfig(
    init=InitConfig(method="random", count=60),
    sparse=SparseConfig(symmetry="off"),
    checkpoint_every=0,
    preview_every=0,
)
SMALLER = (
    (reconstruction_pairs, "reconstruction_config", lambda length, seed: replace(FEW.with_steps(6), seed=seed)),
    (reconstruction_pairs, "HELD_OUT_VIEWS", 1),
    (evaluation, "MAX_RENDERS", 1),
    (evaluation, "NOISE_STEPS_EVALUATED", (500,)),
    (view_conditioned, "UNET_WIDTHS", (16, 16, 16)),
)
"""Makes the training of a prior small: how much it learns is not what is tested."""


class ForkedChild:
    """Takes the place of Popen for the child of `gsopt sfm`: a fork, so that COLMAP is imported once."""

    def __init__(self, command: list[str], stderr: IO[bytes], **_: Any) -> None:
        (stdin, self.stdin), (self.stdout, stdout) = (
            (os.fdopen(end, mode, encoding="utf-8") for end, mode in zip(os.pipe(), "rw", strict=True)) for _ in "io"
        )
        self.pid = os.fork()
        if self.pid == 0:
            self.stdin.close()
            for file, number in ((stdin, 0), (stdout, 1), (stderr, 2)):
                os.dup2(file.fileno(), number)
            sys.argv, sys.stdin = command[2:], stdin
            child_process.main()
            os._exit(1)
        stdin.close()
        stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stdin.close()
        self.stdout.close()

    def wait(self) -> int:
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)


class ForkFarm:
    """Takes the place of the farm of `gsopt bench --suite`: a fork for every run, so that torch is imported once."""

    def run(self, jobs: list[Job], report: Any = None) -> Iterator[Outcome]:
        for job in jobs:
            reader, writer = os.pipe()
            child = os.fork()
            if child == 0:
                try:
                    with open(writer, "w") as file:
                        json.dump(answer_of(job), file)
                finally:
                    os._exit(0)
            os.close(writer)
            with open(reader) as file:
                answer = json.loads(file.read() or '{"failed": "it died"}')
            os.waitpid(child, 0)
            failed = answer.get("failed")
            yield Outcome(job, "failed", error=failed) if failed else Outcome(job, "done", answer)


def answer_of(job: Job) -> dict[str, Any]:
    try:
        return single_run.answer(job.request)
    except (RunFailed, GsoptError) as error:
        return {"failed": str(error)}


SYNTH_VIEWS = str(Path(__file__).resolve().parents[2] / "scripts" / "synth_views.py")
LOCAL_FARM = open_farm.open_farm
"""Starts Blender anew for every run, which takes it a second or two."""
KINDS = ("none", "kill", "fail once", "fail from here", "short")
LONGEST_SECONDS = 900
"""A run takes seconds, or minutes on a machine with much else to do."""
FULL = os.environ.get("GSOPT_EVERY_WRITE") == "full"


def prepare() -> None:
    """Does once what every job would do again."""
    torch.set_num_threads(1)
    for module, name, value in SMALLER:
        assert hasattr(module, name), f"{module.__name__} has no {name}"
        setattr(module, name, value)
    if FULL:
        view_conditioned.make_unet(0)  # imports diffusers, for seconds
        importlib.import_module("gsopt.data.sfm.pipeline")
        importlib.import_module("pycolmap")
        open_farm.open_farm = lambda *_: ForkFarm()
        child_process.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": ForkedChild})


def run(job: dict[str, Any], faults: ctypes.CDLL) -> NoReturn:
    log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    signal.alarm(LONGEST_SECONDS)
    folder, kind = os.fsencode(job["folder"]), KINDS.index(job["kind"])
    os.environ["FAULTS_ARM"] = f"{kind}:{job['errno']}:{job['at']}:{job['folder']}"  # for programs that it starts
    faults.faults_arm(folder, kind, job["errno"], ctypes.c_long(job["at"]))
    os._exit(program(job["arguments"]))


def program(arguments: list[str]) -> int:
    """Runs a script of this checkout where its path comes first, else gsopt."""
    if arguments[0] != SYNTH_VIEWS:
        return main(arguments)
    sys.path.insert(0, str(Path(SYNTH_VIEWS).parent))
    synth_views = importlib.import_module("synth_views")
    synth_views.open_farm = LOCAL_FARM  # type: ignore[attr-defined]
    return int(synth_views.main(arguments))


def serve() -> None:
    faults = ctypes.CDLL(os.environ["LD_PRELOAD"])
    faults.faults_calls.restype = ctypes.c_long
    prepare()
    for line in sys.stdin:
        job = json.loads(line)
        Path(job["folder"]).mkdir(parents=True, exist_ok=True)
        child = os.fork()
        if child == 0:
            run(job, faults)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        outcome = {"code": code, "calls": faults.faults_calls(), "happened": bool(faults.faults_happened())}
        print(json.dumps(outcome), flush=True)


if __name__ == "__main__":
    serve()
