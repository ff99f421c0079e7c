"""Repeated measurements: CPU time of the process beside wall time, as median and distance between the quartiles."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Reading:
    """One repetition, seconds."""

    cpu: float
    """CPU time of all threads of this process; other work on the machine does not add to it, but may slow caches."""
    wall: float


def read(action: Callable[[], object]) -> Reading:
    """Time one call."""
    cpu, wall = time.process_time(), time.perf_counter()
    action()
    return Reading(time.process_time() - cpu, time.perf_counter() - wall)


def repeat(action: Callable[[], object], repetitions: int, warm_up: int = 2) -> list[Reading]:
    """Times `repetitions` calls after `warm_up` calls that are not counted."""
    for _ in range(warm_up):
        action()
    return [read(action) for _ in range(repetitions)]


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """Median and interquartile range in milliseconds."""
    milliseconds = [1000 * value for value in seconds]
    if len(milliseconds) < 2:
        return {"median": milliseconds[0], "iqr": 0.0}
    low, _, high = statistics.quantiles(milliseconds, n=4, method="inclusive")
    return {"median": round(statistics.median(milliseconds), 4), "iqr": round(high - low, 4)}


def both(readings: Sequence[Reading]) -> dict[str, Any]:
    """CPU and wall time of the same repetitions."""
    return {"cpu_ms": spread([r.cpu for r in readings]), "wall_ms": spread([r.wall for r in readings])}
