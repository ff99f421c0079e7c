"""Standard output and error that never stop the work: a run outlives the terminal, pipe or disk it prints to."""

from __future__ import annotations

import io
import os
import sys
import time
from typing import Any


class LastingFile(io.RawIOBase):
    """The file beneath a stream, which drops what cannot be written: the reader is gone, or the disk is full."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        self._stream = stream  # closes its file when it goes
        self._file: Any = getattr(stream.buffer, "raw", stream.buffer)
        self.failure: OSError | None = None

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return int(self._file.fileno())

    def isatty(self) -> bool:
        return bool(self._file.isatty())

    def write(self, data: bytes) -> int:  # type: ignore[override]
        try:
            written: int | None = self._file.write(data)
        except OSError as error:
            self.failure = error
            return len(data)
        if written is None:  # a pipe that does not block is full: the buffer above calls again
            time.sleep(0.01)
        return written or 0


def outlast_readers() -> LastingFile | None:
    """Makes stdout and stderr lasting and able to print any text, once; returns what is beneath stdout,
    or None where a caller put streams of its own in their place, which are left as they are.

    Closed descriptors are opened first: the next file that is opened would become stdout otherwise.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stderr is sys.__stderr__:
        sys.stderr = lasting(sys.stderr)[0]
    if sys.stdout is not sys.__stdout__:
        return None
    sys.stdout, beneath = lasting(sys.stdout)
    return beneath


def lasting(stream: io.TextIOWrapper | None) -> tuple[io.TextIOWrapper, LastingFile]:
    """A text stream to the same place, or to nowhere for none, and the file beneath it."""
    if stream is None:
        stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 (open as long as the process)
    stream.flush()
    at_once = stream.line_buffering or stream.write_through
    file = LastingFile(stream)
    buffer = io.BufferedWriter(file)  # type: ignore[type-var]  # its stub wants a file that can be read too
    return io.TextIOWrapper(buffer, stream.encoding, "backslashreplace", line_buffering=at_once), file
