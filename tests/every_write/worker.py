"""Runs command lines of gsopt on a faulty disk: one JSON job a line on stdin, its outcome on stdout.

Every job runs in a fork, so that torch is imported once. LD_PRELOAD names the compiled faulty_disk.c.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, NoReturn, Self

import torch
from PIL import Image

import gsopt.cli.train  # noqa: F401 (jobs would import it anew)
from gsopt.benchmark.suite import single_run
from gsopt.cli import main, serve_jobs, train_flags
from gsopt.config.train import InitConfig, SparseConfig, TrainConfig
from gsopt.data.sfm import child_process
from gsopt.farm import open as open_farm
from gsopt.farm import worker as farm_worker
from gsopt.farm.job import Job, Outcome
from gsopt.farm.serve import serve
from gsopt.farm.worker import Worker
from gsopt.finetune import evaluation as prior_evaluation
from gsopt.finetune import reconstruction_pairs, serve_pairs
from gsopt.results import evaluation
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
    (prior_evaluation, "MAX_RENDERS", 1),
    (prior_evaluation, "NOISE_STEPS_EVALUATED", (500,)),
    (view_conditioned, "UNET_WIDTHS", (16, 16, 16)),
)
"""Makes the training of a prior small: how much it learns is not what is tested."""


class ForkedChild:
    """Takes the place of Popen for a program that is a module of gsopt: a fork, so that its imports are made once."""

    def __init__(
        self,
        command: Sequence[str],
        stderr: IO[bytes],
        env: Mapping[str, str],
        start_new_session: bool = False,
        **_: Any,
    ) -> None:
        (stdin, self.stdin), (self.stdout, stdout) = (
            (os.fdopen(end, mode, encoding="utf-8") for end, mode in zip(os.pipe(), "rw", strict=True)) for _ in "io"
        )
        self._code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            self.stdin.close()
            self.stdout.close()
            if start_new_session:
                os.setsid()
            for file, number in ((stdin, 0), (stdout, 1), (stderr, 2)):
                os.dup2(file.fileno(), number)
            os.environ.update(env)
            sys.argv, sys.stdin = list(command[2:]), stdin
            PROGRAMS[command[2]]()
            os._exit(1)
        stdin.close()
        stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stdin.close()
        self.stdout.close()

    def poll(self) -> int | None:
        return self._ended(os.WNOHANG)

    def wait(self) -> int | None:
        return self._ended(0)

    def _ended(self, flags: int) -> int | None:
        if self._code is None:
            ended, status = os.waitpid(self.pid, flags)
            self._code = os.waitstatus_to_exitcode(status) if ended else None
        return self._code

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)


PROGRAMS: dict[str, Callable[[], None]] = {
    "gsopt.data.sfm.child_process": child_process.main,
    "gsopt.benchmark.suite.worker": lambda: serve(single_run.answer),
    "gsopt.finetune.serve_pairs": lambda: serve(serve_pairs.handle),
    "gsopt.cli.serve_jobs": lambda: serve(serve_jobs.handle),
}
FORKING = SimpleNamespace(**{**vars(subprocess), "Popen": ForkedChild})


class ForkWorker(Worker):
    """A worker, and what it starts, is a fork. Blender's workers, of another farm, are programs of their own."""

    def do(self, job: Job, request: Any, canceled: Callable[[], bool] = lambda: False) -> Outcome:
        farm_worker.subprocess = FORKING  # type: ignore[assignment]
        return super().do(job, request, canceled)


class ForkFarm:
    """Takes the place of the farm of `gsopt bench --suite`: one worker, in a fork, so that torch is imported once."""

    def run(self, jobs: list[Job], report: Any = None) -> Iterator[Outcome]:
        worker = ForkWorker()
        try:
            for job in jobs:
                outcome = worker.do(job, job.request)
                print(outcome.output)
                yield outcome
        finally:
            worker.end()


SYNTH_VIEWS = str(Path(__file__).resolve().parents[2] / "scripts" / "synth_views.py")
LOCAL_FARM = open_farm.open_farm
"""Starts Blender anew for every run, which takes it a second or two."""
KINDS = ("none", "kill", "fail once", "fail from here", "short")
LONGEST_SECONDS = 900
"""A run takes seconds, or minutes on a machine with much else to do."""
IMPORTED_BY_JOBS = (
    *("gsopt.cli.sfm", "gsopt.data.sfm.pipeline", "pycolmap", "gsopt.cli.bench", "gsopt.benchmark.suite.run_figures"),
    *("gsopt.benchmark.suite.html_page", "gsopt.results.report.page", "gsopt.training.reconstruct"),
    *("gsopt.raster.device.backend", "gsopt.shape_prior.completion", "gsopt.formats.compressed_ply"),
    *("gsopt.training.guided.start", "gsopt.training.library_body", "gsopt.training.density.adc"),
    "gsopt.data.sfm.reuse",
)
FULL = os.environ.get("GSOPT_EVERY_WRITE") in ("full", "all")


def prepare() -> None:
    """Does once what every job would do again."""
    torch.set_num_threads(1)
    for module, name, value in SMALLER:
        assert hasattr(module, name), f"{module.__name__} has no {name}"
        setattr(module, name, value)
    if FULL:
        view_conditioned.make_unet(0)  # imports diffusers, for seconds
        for name in IMPORTED_BY_JOBS:
            importlib.import_module(name)
        Image.init()
        train_flags.parse(["scene"])
        evaluation.Lpips = functools.cache(evaluation.Lpips)  # type: ignore[attr-defined]
        evaluation.networks()
        open_farm.open_farm = lambda *_: ForkFarm()
        child_process.subprocess = FORKING  # type: ignore[assignment]
        single_run.Worker = ForkWorker  # type: ignore[misc]
    gc.freeze()  # so that a fork copies fewer pages


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


def run_jobs() -> None:
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
    run_jobs()
