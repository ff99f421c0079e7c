"""Asks a run to finish its step: SIGINT, SIGTERM, SIGHUP, or an empty file `stop` in the run directory."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

SIGNALS = [signal.SIGINT, signal.SIGTERM]
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup sets it
    SIGNALS.append(signal.SIGHUP)


class Stopped(Exception):
    """Ends work that has no steps; raised by `StopRequest.check`."""


class StopRequest:
    """True once someone asked. A second SIGINT does not wait: it raises KeyboardInterrupt.

    Signal handlers are replaced only in the main thread, and put back on exit. A request within another one holds for
    both.
    """

    def __init__(self, stop_file: Path) -> None:
        self._file = stop_file
        self._signalled = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._receive) for number in SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def __bool__(self) -> bool:
        return self._signalled or self._file.exists()

    def check(self, *_progress: object) -> None:
        """Raise Stopped when someone asked; takes the arguments of any report of progress."""
        if self:
            raise Stopped

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self._signalled and number == signal.SIGINT:
            raise KeyboardInterrupt
        self._signalled = True
        outer = getattr(self._previous[signal.Signals(number)], "__self__", None)
        if isinstance(outer, StopRequest):
            outer._signalled = True
