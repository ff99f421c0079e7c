"""The run directory: the only thing a run shares with Blender, the viewer or a CI job.

`config.json` first and complete; `events.jsonl` append-only, one writer, one `os.write` per line
(`{"v": 1, "seq": n, "kind": ...}`), its last line one of done, stopped, error; an empty file `stop` asks the run
to finish its step, save and exit. A reader tails by byte offset up to the last newline.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from gsopt.errors import InputError, UsageError

VERSION = 1
LARGEST_LOG = 1 << 28
"""Bytes of events; a run of days has a tenth of it."""
LARGEST_METRICS = 64 << 20
"""Bytes of metrics.json that are read."""
LAST = ("done", "stopped", "error")
WRITTEN_IN_PLACE = ("events.jsonl", "log.txt", "previews", "checkpoints", "guidance", "frames", "renders")
"""Files that are appended to and folders that are written into; every other file is replaced as a whole."""

TEMPORARY = re.compile(r"\..+\.\d+\.tmp|\.tmp\w{6}")
"""Names of files before they are whole: a dot, the name, the process; and what safetensors takes."""

_APPEND = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_NOFOLLOW", 0)  # Windows lacks the last one

Report = Callable[[str], None]
"""Takes one line of progress, or a warning, for the user."""


def write_atomic(path: Path, data: bytes) -> None:
    """Write a whole file or nothing: to a temporary name, flushed to disk, then renamed over `path`."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with create(temporary) as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(
            f"Cannot write {path}: {error.strerror or error}. Free some space or choose another folder."
        ) from error


def sync_folder(folder: Path) -> None:
    """Make the new names in a folder outlast a power cut; Windows and some network disks cannot."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def create(temporary: Path) -> BinaryIO:
    """A new file `.NAME.PROCESS.tmp`, in the place of whatever killed writers of NAME or a stranger left there."""
    temporary.unlink(missing_ok=True)
    if os.name == "posix":  # elsewhere one cannot ask for a process without harm
        for other in temporary.parent.glob(f"{glob.escape(temporary.name.rsplit('.', 2)[0])}.*.tmp"):
            if writer_is_dead(other):
                other.unlink(missing_ok=True)
    return open(temporary, "xb")


def sweep(*folders: Path) -> None:
    """Removes what a killed writer left half done. The caller knows that nobody else is writing there."""
    for folder in folders:
        for file in folder.iterdir():
            if TEMPORARY.fullmatch(file.name):
                file.unlink(missing_ok=True)


def writer_is_dead(temporary: Path) -> bool:
    """True when no process has the number in the name `.NAME.PROCESS.tmp`."""
    number = temporary.name.rsplit(".", 2)[1]
    if not number.isascii() or not number.isdigit() or not 0 < int(number) < 1 << 31:
        return False
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return False


def refuse_links(run: Path) -> None:
    """InputError when something in a run directory that is written in place is a symbolic link, one level deep.

    A run directory may come from a stranger: a link would lead the writer to any file of the user.
    """
    for path in (run / name for name in WRITTEN_IN_PLACE):
        for place in (path, *(path.iterdir() if path.is_dir() and not path.is_symlink() else ())):
            if place.is_symlink():
                raise InputError(f"{place} must not be a symbolic link, got one. Remove it, or move its target here.")


def to_json(value: Any) -> bytes:
    """Readable, strict JSON (NaN is refused) with a final newline."""
    return encoded(json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def encoded(text: str) -> bytes:
    """UTF-8; of file names that are none, the bytes that are no text as the escapes JSON has for them."""
    return text.encode("utf-8", "backslashreplace")


class EventWriter:
    """Appends events to `events.jsonl`; continues the numbering of an earlier run in the same folder.

    Holds an advisory lock on the file while open, which a killed process gives back by dying.
    """

    def __init__(self, run: Path) -> None:
        self.path = run / "events.jsonl"
        previous, end = read_events(self.path)
        self._seq = previous[-1]["seq"] + 1 if previous else 0
        try:
            self._fd = os.open(self.path, _APPEND, 0o644)
        except OSError as error:
            raise InputError(f"Cannot write {self.path}: {error.strerror}. Choose another folder.") from error
        _lock(self._fd, self.path)
        if os.fstat(self._fd).st_size > end:
            self._append(b"\n")  # a killed writer left half a line: close it off, readers skip it

    def emit(self, kind: str, **fields: Any) -> dict[str, Any]:
        """One line, one write; returns the event."""
        event = {"v": VERSION, "seq": self._seq, "kind": kind, "time": round(time.time(), 3), **fields}
        self._append(encoded(json.dumps(event, allow_nan=False, ensure_ascii=False) + "\n"))
        self._seq += 1
        return event

    def _append(self, line: bytes) -> None:
        """The whole line, or InputError and nothing of it: what a full disk took of it is cut off again."""
        size = os.fstat(self._fd).st_size
        written = 0
        try:
            while written < len(line):
                written += os.write(self._fd, line[written:])
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, size)
            raise InputError(
                f"Cannot write {self.path}: {error.strerror or error}. Free some space, then continue with --resume."
            ) from error

    def close(self) -> None:
        os.close(self._fd)


def _lock(descriptor: int, path: Path) -> None:
    """One writer per run: UsageError where another process holds the file. Not available on Windows."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise UsageError(f"Another process is writing {path}. Wait for it, or choose another folder.") from error


def read_events(path: Path, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """Events after byte `offset` and the offset to go on from; broken lines are skipped.

    Raises InputError for a higher version, for a file that cannot be read and for more than LARGEST_LOG bytes.
    """
    if not path.exists():
        return [], offset
    try:
        with open(path, "rb") as file:
            file.seek(offset)
            data = file.read(LARGEST_LOG + 1)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}. Check the run's folder.") from error
    if len(data) > LARGEST_LOG:
        raise InputError(f"{path} has more than {LARGEST_LOG >> 20} MB of events. Move it away.")
    end = data.rfind(b"\n") + 1
    events: list[dict[str, Any]] = []
    for line in data[:end].splitlines():
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(event, Mapping) or not isinstance(event.get("seq"), int):
            continue
        if event.get("v") != VERSION:
            raise InputError(
                f"{path} speaks protocol version {event.get('v')}, this gsopt reads {VERSION}. Update gsopt."
            )
        events.append(dict(event))
    return events, offset + end
