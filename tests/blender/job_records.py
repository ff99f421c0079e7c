"""Records of jobs as a downloaded folder may have them."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from blender_addon.core import job


def wait(running: job.Job) -> None:
    until = time.monotonic() + 30
    while job.alive(running):
        assert time.monotonic() < until
        time.sleep(0.02)


def record_of(folder: Path, changed: dict[str, Any]) -> None:
    """Writes the record of a job that has ended, with other values in it."""
    running = job.start("train", [sys.executable, "-c", ""], folder)
    wait(running)
    values = json.loads((folder / job.RECORD).read_text(encoding="utf-8"))
    (folder / job.RECORD).write_text(json.dumps(values | changed), encoding="utf-8")


HOSTILE_RECORDS: list[dict[str, Any]] = [
    *({"folder": value} for value in (3, None, "a\0b", "\ud800", ["a"])),
    *({"pid": value} for value in (2**70, -1, True, 1.0, "1", None)),
    *({"arguments": value} for value in ("python", [], [3], ["a\0b"], ["\ud800"], {})),
    *({"product": value} for value in (7, "a\0b", "\udcff")),
    *({"total": value} for value in (-1, 10**30, "9")),
    {"kind": 1},
    {"identity": []},
    {"started": "now"},
    {"unknown": 1},
]
