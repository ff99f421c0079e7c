"""This module drives `worker.py`, which runs command lines of gsopt on a disk that fails at a chosen call."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Fault:
    """What happens at one call that changes the watched folder."""

    kind: str
    errno: int = 0

    def __str__(self) -> str:
        return f"{self.kind} {errno.errorcode.get(self.errno, '')}".strip()


HEALTHY = Fault("none")
FAULTS = (
    Fault("kill"),
    Fault("fail once", errno.ENOSPC),
    Fault("fail from here", errno.ENOSPC),
    Fault("fail once", errno.EIO),
    Fault("short"),
)


@dataclass(frozen=True)
class Outcome:
    """How a command ended: its exit code (-9 for a kill), and its number of calls that change the watched folder."""

    code: int
    calls: int
    happened: bool


class FaultyDisk:
    """One worker process; every command runs in a fork of it."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self._process = process
        self.log = log

    def run(self, arguments: Sequence[str], watched: Path, fault: Fault = HEALTHY, at: int = 0) -> Outcome:
        """Runs `gsopt ARGUMENTS`; the `at`-th change of the folder `watched` meets the fault."""
        self.log.unlink(missing_ok=True)
        job = {"arguments": list(arguments), "folder": str(watched), "kind": fault.kind, "errno": fault.errno, "at": at}
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({**job, "log": str(self.log)}) + "\n")
        self._process.stdin.flush()
        return Outcome(**json.loads(self._process.stdout.readline()))


def compiler() -> str | None:
    """The C compiler at hand; the library it makes is for Linux."""
    return shutil.which(os.environ.get("CC", "cc")) if sys.platform == "linux" else None


@contextmanager
def faulty_disk(folder: Path) -> Iterator[FaultyDisk]:
    """Compiles the library into `folder` and starts a worker under it."""
    library = folder / "faulty_disk.so"
    command = [str(compiler()), "-O1", "-Wall", "-Werror", "-shared", "-fPIC", str(HERE / "faulty_disk.c"), "-ldl"]
    subprocess.run([*command, "-o", str(library)], check=True)
    worker = [sys.executable, str(HERE / "worker.py")]
    count = folder / "count"
    count.write_bytes(bytes(64))
    env = {**os.environ, "LD_PRELOAD": str(library), "FAULTS_FILE": str(count)}
    with subprocess.Popen(worker, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, text=True) as process:
        yield FaultyDisk(process, folder / "log")
