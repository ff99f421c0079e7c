"""Runs command lines of gsopt on a faulty disk: one JSON job a line on stdin, its outcome on stdout.

Every job runs in a fork, so that torch is imported once. LD_PRELOAD names the compiled faulty_disk.c.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any, NoReturn

import torch

import gsopt.cli.train  # noqa: F401 (jobs would import it anew)
from gsopt.cli import main
from gsopt.finetune import evaluation, reconstruction_pairs

reconstruction_pairs.STEP_COUNTS, evaluation.MOST = (12,), 2  # how much a prior learns is not what is tested

KINDS = ("none", "kill", "fail once", "fail from here", "short")
LONGEST_SECONDS = 120


def run(job: dict[str, Any], faults: ctypes.CDLL) -> NoReturn:
    log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 1)
    os.dup2(log, 2)
    signal.alarm(LONGEST_SECONDS)
    folder, kind = os.fsencode(job["folder"]), KINDS.index(job["kind"])
    os.environ["FAULTS_ARM"] = f"{kind}:{job['errno']}:{job['at']}:{job['folder']}"  # for programs that it starts
    faults.faults_arm(folder, kind, job["errno"], ctypes.c_long(job["at"]))
    os._exit(main(job["arguments"]))


def serve() -> None:
    faults = ctypes.CDLL(os.environ["LD_PRELOAD"])
    faults.faults_calls.restype = ctypes.c_long
    torch.set_num_threads(1)
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
