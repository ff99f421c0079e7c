"""Follow a run by its directory alone (docs/protocol.md of gsopt): bounded reads, never a wait.

Whoever polls gets what is known so far. Half a line waits for its rest, lines that are no events are skipped, a higher
protocol version is refused, and a reader that is far behind skips ahead.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from . import job as jobs
from .errors import InputError, printable
from .files import is_text

PROTOCOL = 1
PIECE = 1 << 18
"""Bytes read at a time: a few milliseconds of work."""
FAR_BEHIND = 1 << 21
"""From here on the reader skips ahead to the last piece."""
SILENCE = 900.0
"""Seconds without a word after which a run counts as ended where its process is not known."""
FINAL = ("done", "stopped", "error")
MOST_MESSAGES = 50
STOP_FLAGS = os.O_WRONLY | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Neither makes what a symlink names nor waits for the reader of a pipe."""
LONGEST = 500


@dataclass
class Run:
    """State of a run as read so far."""

    path: Path
    status: str = "waiting"
    """waiting, running, done, stopped, error, killed or unreadable."""
    step: int = 0
    total: int = 0
    count: int = 0
    """Gaussians."""
    psnr: float | None = None
    eta: float | None = None
    """Seconds."""
    preview: str = ""
    """The newest file to show, absolute; empty where there is none."""
    pid: int = 0
    began: float = 0.0
    """Time of the last `started`, seconds since 1970."""
    messages: list[str] = field(default_factory=list)
    """Warnings and errors, the newest last."""

    @property
    def problem(self) -> str:
        """The last thing that went wrong, if the run is over because of it."""
        return self.messages[-1] if self.messages and self.status in ("error", "killed", "unreadable") else ""

    def say(self, message: object) -> None:
        text = printable(" ".join(str(message).split())[:LONGEST])
        if not self.messages or self.messages[-1] != text:
            self.messages = [*self.messages[1 - MOST_MESSAGES :], text]


class Follower:
    """Reads a run's events as they come."""

    def __init__(self, path: Path, job: jobs.Job | None = None, told: int = 0) -> None:
        self.run = Run(path)
        self.job = job
        self._offset = told
        self._broken = False

    def poll(self) -> Run:
        """Read at most one piece, look whether the process lives, and tell what is known."""
        if self.run.status != "unreadable":
            try:
                behind = self._read()
            except InputError as error:
                self.run.status = "unreadable"
                self.run.say(error)
                return self.run
            if not behind and self.run.status in ("waiting", "running"):
                self._check_process()
        return self.run

    def _read(self) -> bool:
        """Take in one piece; whether there is more."""
        path = self.run.path / "events.jsonl"
        try:
            with open(path, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                if size < self._offset:
                    self._offset = 0  # another file under the same name
                if size - self._offset > FAR_BEHIND:
                    self._offset, self._broken = size - PIECE, True
                file.seek(self._offset)
                data = file.read(PIECE)
        except FileNotFoundError:
            return False
        except OSError as error:
            raise InputError(f"Cannot read {path}: {error.strerror}. Check the folder.") from error
        end = data.rfind(b"\n") + 1
        if not end and len(data) == PIECE:
            self._offset, self._broken = self._offset + PIECE, True  # no event is that long: skip to its end
            return True
        lines = data[:end].split(b"\n")
        broken, self._broken = self._broken, self._broken and not end
        self._offset += end  # first: what cannot be taken is not read again
        for event in events_in(lines[1:] if broken else lines, path):
            self._take(event)
        return self._offset < size and end > 0 and len(data) == PIECE

    def _take(self, event: dict[str, Any]) -> None:
        run, kind = self.run, event.get("kind")
        if kind == "started":
            run.status, run.pid = "running", whole(event.get("pid"))
            run.began = number(event.get("time")) or 0.0
        if kind == "progress":
            run.status = "running"
            run.psnr, run.eta = number(event.get("psnr")), number(event.get("eta_seconds"))
        if kind in ("started", "progress", "done", "stopped"):
            run.step = whole(event.get("step"), run.step)
            run.total = whole(event.get("total"), run.total)
            run.count = whole(event.get("n"), run.count)
        if kind == "preview":
            run.preview = inside(run.path, event.get("path")) or run.preview
        if kind in ("warning", "guidance", "error"):
            run.say(event["message"] if isinstance(event.get("message"), str) else "")
        if kind in FINAL:
            run.status, run.eta = str(kind), None

    def _check_process(self) -> None:
        run = self.run
        if self.job is not None:
            if not jobs.alive(self.job) and not self._more():
                run.status = "killed" if run.status == "running" else "error"
                said = jobs.complaint(self.job) if run.status == "error" else "It ended without a word. See the log."
                run.say(f"{said} Continue it with Resume." if run.status == "killed" else said)
        elif run.status == "running" and not self._goes_on():
            run.status = "killed"
            run.say("The run was killed. Continue it from its last checkpoint with Resume.")
        elif run.status == "waiting" and time.time() - changed(run.path) > SILENCE:
            run.status = "error"
            run.say("It has said nothing for a long time and seems to have ended before its first step. See its log.")

    def _goes_on(self) -> bool:
        """True while the process lives; when the reader skipped its id, true while the run writes events."""
        if self.run.pid:
            return jobs.process_alive(self.run.pid, self.run.began)
        return time.time() - changed(self.run.path / "events.jsonl") < SILENCE

    def _more(self) -> bool:
        """True when the process wrote something between the last read and its end."""
        try:
            return (self.run.path / "events.jsonl").stat().st_size > self._offset and self._read_rest()
        except OSError:
            return False

    def _read_rest(self) -> bool:
        before = self._offset
        self._read()
        return self._offset > before


def events_in(lines: list[bytes], path: Path) -> Iterator[dict[str, Any]]:
    """The events among these lines. InputError for a protocol this reader does not know."""
    for line in lines:
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(event, dict) or not all(isinstance(event.get(name), int) for name in ("seq", "v")):
            continue
        version = event.get("v")
        if version != PROTOCOL:
            raise InputError(
                f"{path} speaks protocol version {str(version)[:20]}, this extension knows {PROTOCOL}. "
                "Install the extension that came with that gsopt."
            )
        yield event


def whole(value: Any, otherwise: int = 0) -> int:
    """A whole number that Blender's properties can hold."""
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31 else otherwise


def number(value: Any) -> float | None:
    """A number that Blender's properties can hold."""
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e30
    return float(value) if usable else None


def inside(run: Path, name: Any) -> str:
    """An announced file of the run, absolute; empty when it is none or points out of the directory."""
    if not name or not is_text(name):
        return ""
    try:
        path = (run / name).resolve()
    except (OSError, ValueError):  # a name that no file system has
        return ""
    return str(path) if path.is_relative_to(run.resolve()) else ""


def changed(path: Path) -> float:
    """Time of the last change of a file or of a folder's list, seconds since 1970; now when unknown."""
    try:
        return path.stat().st_mtime
    except OSError:
        return time.time()


def length(run: Path) -> int:
    """Bytes of events so far: where a session that is about to begin will begin."""
    try:
        return (run / "events.jsonl").stat().st_size
    except OSError:
        return 0


def ask_to_stop(run: Path) -> None:
    """The run finishes its step, saves and exits. InputError where the request cannot be written."""
    try:
        os.close(os.open(run / "stop", STOP_FLAGS, 0o666))
    except OSError as error:
        raise InputError(f"Cannot write {run / 'stop'}: {error.strerror}. End its process instead.") from error


def splats_of(run: Path) -> Path | None:
    """The file to import: the result, else the newest preview, else nothing."""
    result = run / "splat.ply"
    if result.is_file():
        return result
    previews = sorted(p for p in (run / "previews").glob("step_*.ply") if not p.name.startswith("."))
    return previews[-1] if previews else None


def sequence_of(folder: Path) -> list[Path]:
    """The splats to show one after the other: the previews of a run and its result, or the results of the runs in a
    folder, by name. InputError where these are fewer than two."""
    found = sorted(p for p in (folder / "previews").glob("step_*.ply") if not p.name.startswith("."))
    found += [p for p in (folder / "splat.ply",) if p.is_file()]
    if not found:
        found = [run / "splat.ply" for run in sorted(earlier_runs(folder), key=lambda run: run.name)]
        found = [path for path in found if path.is_file()]
    if len(found) < 2:
        raise InputError(f"{folder} must hold two or more splats: previews of a run, or finished runs. Choose another.")
    return found


def earlier_runs(parent: Path, most: int = 100) -> list[Path]:
    """Run directories in a folder, the newest first."""
    try:
        found = [(entry.stat().st_mtime, Path(entry.path)) for entry in os.scandir(parent) if entry.is_dir()]
    except OSError:
        return []
    newest = sorted(found, reverse=True)[: 4 * most]
    return [path for _, path in newest if (path / "config.json").is_file() or (path / "events.jsonl").is_file()][:most]
