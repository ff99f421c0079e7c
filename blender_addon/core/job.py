"""Programs that outlive Blender: started from an argument list, watched by process id, ended politely.

A job is a folder: job.json (what was started, its process id, what it shall make) and output.txt (all it printed).
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .errors import InputError, UsageError
from .files import is_text, read_json, write_json

VERSION = 2
RECORD, OUTPUT = "job.json", "output.txt"
FOREIGN = ("PYTHON", "BLENDER_", "VIRTUAL_ENV", "__PYVENV", "CONDA_PYTHON")
"""Variables of Blender's own Python that would lead another Python astray."""
LOADER = ("LD_LIBRARY_PATH", "LD_PRELOAD", "DYLD_LIBRARY_PATH", "DYLD_INSERT_LIBRARIES")
TAIL = 1 << 16
"""Bytes at the end of an output that are read."""
BOOT = Path("/proc/sys/kernel/random/boot_id")
"""Linux: another text after every start of the machine."""

_children: dict[int, subprocess.Popen[bytes]] = {}


@dataclass(frozen=True)
class Job:
    """A program that was started."""

    kind: str
    """train, poses, dataset, prompts, doctor, install, page, clean, mesh or measure."""
    folder: str
    arguments: tuple[str, ...]
    pid: int
    started: float
    """Seconds since 1970."""
    product: str = ""
    """The file or folder that it shall make."""
    total: int = 0
    """Number of items it makes one by one, such as images; 0 when unknown."""
    identity: str = ""
    """Id, boot and start of its process, as `identity` returns them."""


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment of another Python: nothing that Blender set for its own, output in UTF-8 and at once."""
    kept = {k: v for k, v in environment.items() if not k.upper().startswith(FOREIGN)}
    for name in LOADER:
        if name in kept and "blender" in kept[name].lower():
            del kept[name]
    return kept | {"PYTHONUTF8": "1", "PYTHONUNBUFFERED": "1"}


def start(kind: str, arguments: Sequence[str], folder: Path, product: Path | None = None, total: int = 0) -> Job:
    """Start a program with `folder` (made if need be) as its working folder. UsageError when it cannot be started."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        output = open(folder / OUTPUT, "wb")  # noqa: SIM115  the child keeps it
    except OSError as error:
        raise InputError(f"Cannot write to {folder}: {error.strerror}. Choose another folder for the work.") from error
    apart: dict[str, object] = {"start_new_session": True}
    if sys.platform == "win32":
        apart = {"creationflags": subprocess.DETACHED_PROCESS | subprocess.CREATE_NEW_PROCESS_GROUP}
    with output:
        try:
            process = subprocess.Popen(
                list(arguments),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env=clean_environment(os.environ),
                **apart,  # type: ignore[call-overload]
            )
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(
                f"Cannot start {arguments[0]}: {reason}. Set the interpreter in the preferences."
            ) from error
    _children[process.pid] = process
    pid, born = process.pid, identity(process.pid)
    job = Job(kind, str(folder), tuple(arguments), pid, time.time(), str(product or ""), total, born)
    try:
        write_json(folder / RECORD, {"version": VERSION, **asdict(job)})
    except InputError:
        end(job)
        raise
    return job


def read_job(folder: Path) -> Job:
    """The job of a folder. InputError where there is none, or of another version."""
    values = read_json(folder / RECORD)
    if values.pop("version", None) != VERSION:
        raise InputError(f"{folder / RECORD} is of another version of the extension. Start the work again.")
    try:
        values |= {"folder": str(folder), "arguments": require_record(values)}
        return Job(**values)
    except (TypeError, KeyError, ValueError) as error:
        raise InputError(f"{folder / RECORD} is damaged: {error}. Start the work again.") from error


def require_record(values: dict[str, Any]) -> tuple[str, ...]:
    """The argument list of a record. ValueError, KeyError or TypeError for values that no job has."""
    texts, numbers = ("kind", "folder", "product", "identity"), ("pid", "total")
    if not isinstance(values["arguments"], list) or not values["arguments"]:
        raise ValueError("`arguments` must be a list of words")
    if not all(map(is_text, [*values["arguments"], *(values[name] for name in texts)])):
        raise ValueError(f"{', '.join(texts)} and the words of `arguments` must be text")
    if any(type(values[name]) is not int or not 0 <= values[name] < 2**31 for name in numbers):
        raise ValueError("pid and total must be whole numbers below 2^31")
    if not isinstance(values["started"], (int, float)):
        raise ValueError("started must be a number")
    return tuple(values["arguments"])


def alive(job: Job) -> bool:
    """True while it runs; another program does not count, whatever process id a record names."""
    child, found = _children.get(job.pid), identity(job.pid)
    if job.identity != found or (child is None and not found):
        return False
    return process_alive(job.pid, time.time())


def process_alive(pid: int, started_before: float) -> bool:
    """True when the process with this id runs and existed at that time (seconds since 1970)."""
    child = _children.get(pid)
    if child is not None:
        return child.poll() is None
    if pid <= 0:
        return False
    if sys.platform == "win32":
        return _alive_on_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    born = birth(pid)
    return born is None or born <= started_before + 2.0


def identity(pid: int) -> str:
    """Id, boot and start of a process, which no file from elsewhere can know; empty where it is gone or unknown."""
    if sys.platform == "win32":
        return _birth_on_windows(pid)
    with contextlib.suppress(OSError, IndexError):
        if BOOT.is_file():
            return f"{pid} {BOOT.read_text(encoding='ascii').strip()} {proc_fields(pid)[19]}"
        call, environment = ["/bin/ps", "-o", "pid=,lstart=", "-p", str(pid)], {"LC_ALL": "C", "TZ": "UTC"}
        return subprocess.run(call, capture_output=True, text=True, env=environment, check=False).stdout.strip()
    return ""


def proc_fields(pid: int) -> list[str]:
    """Fields of /proc/PID/stat from the state on."""
    return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()


def birth(pid: int) -> float | None:
    """Returns when a process began, seconds since 1970; unknown is None, infinity stands for one that has ended
    and only waits to be noticed by its parent."""
    try:
        fields = proc_fields(pid)
        uptime = float(Path("/proc/uptime").read_text(encoding="ascii").split()[0])
        if fields[0] in "ZX":
            return float("inf")
        return time.time() - uptime + int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def _alive_on_windows(pid: int) -> bool:
    import ctypes

    query, still_active = 0x1000, 259
    kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    handle = kernel.OpenProcess(query, False, pid)
    if not handle:
        return False
    code = ctypes.c_ulong()
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    kernel.CloseHandle(handle)
    return code.value == still_active


def _birth_on_windows(pid: int) -> str:
    """Id and start of a process, 100 ns since 1601; empty where it is gone."""
    import ctypes

    kernel = ctypes.windll.kernel32  # type: ignore[attr-defined,unused-ignore]
    handle, times = kernel.OpenProcess(0x1000, False, pid), [ctypes.c_ulonglong() for _ in range(4)]
    known = handle and kernel.GetProcessTimes(handle, *map(ctypes.byref, times))
    kernel.CloseHandle(handle)
    return f"{pid} {times[0].value}" if known else ""


def end(job: Job, force: bool = False) -> None:
    """Ask it and all it started to end (SIGTERM), or end them (SIGKILL)."""
    if not alive(job):
        return
    with contextlib.suppress(OSError):
        if sys.platform == "win32":
            subprocess.Popen(["taskkill", "/PID", str(job.pid), "/T", *(["/F"] if force else [])])
        else:
            os.killpg(job.pid, signal.SIGKILL if force else signal.SIGTERM)


def exit_code(job: Job) -> int | None:
    """Its exit code, None while it runs or where another Blender started it."""
    child = _children.get(job.pid)
    return None if child is None else child.poll()


def tail(path: Path, size: int = TAIL) -> str:
    """The end of a text file; empty where there is none."""
    try:
        with open(path, "rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - size))
            return file.read(size).decode("utf-8", "replace")
    except OSError:
        return ""


def last_words(job: Job) -> str:
    """The last line that says something: what it did last, or why it ended."""
    text = tail(Path(job.folder) / OUTPUT).replace("\r", "\n")
    lines = [line.strip() for line in text.splitlines() if line.strip(" \t╭╮╰╯│─")]
    return lines[-1][:500] if lines else ""


def complaint(job: Job) -> str:
    """Why it failed, as well as its output tells: the last line that complains, without the frame tyro draws."""
    text = tail(Path(job.folder) / OUTPUT).replace("\r", "\n")
    lines = [line.strip(" \t╭╮╰╯│─") for line in text.splitlines()]
    lines = [line for line in lines if line]
    marks = ("gsopt:", "error:", "Error:", "failed:")
    spoken = [line for line in lines if any(mark in line for mark in marks)]
    code = exit_code(job)
    found = (spoken or lines or [f"it said nothing (exit code {code})"])[-1]
    return found[:500]


def free_folder(parent: Path, stem: str) -> Path:
    """`stem-1`, or the first of stem-2, stem-3, ... that does not exist."""
    number = 1
    while os.path.lexists(parent / f"{stem}-{number}"):
        number += 1
    return parent / f"{stem}-{number}"
