"""`--farm`: a farm by its name."""

from __future__ import annotations

import os
import re

from gsopt import check
from gsopt.errors import UsageError
from gsopt.farm.job import Farm
from gsopt.farm.local import LocalFarm

MAX_CPUS = 1024


def open_farm(name: str, cpus: int, memory: int | None = None) -> Farm:
    """The farm of `--farm NAME`; a bare `local` has `cpus` cores. Raises UsageError for another name."""
    match = re.fullmatch(r"local(?::(\d{1,6}))?", name)
    if match:
        count = int(match[1] or cpus)
        check.within("--farm", count, 1, MAX_CPUS, "Give the cores to use, as local:4.")
        return LocalFarm(count, memory)
    remote = re.fullmatch(r"ray(?:://([^/\s]+:\d{1,5}))?", name)
    if remote:
        from gsopt.farm.ray_farm import RayFarm

        return RayFarm(remote[1] or "")
    raise UsageError(f"`--farm` must be local, local:CORES, ray or ray://HOST:PORT, got {name!r}. Pick one of these.")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
