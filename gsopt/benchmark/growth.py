"""Growth of the cost with the number of Gaussians and with the number of pixels."""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence
from typing import Any

from gsopt.benchmark.kernels import Case, Iteration
from gsopt.benchmark.machine import resident_mb
from gsopt.benchmark.stopwatch import repeat, spread
from gsopt.events import Report

COUNTS = (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)
SIDES = (64, 128, 256, 512, 1024, 2048)
FIXED_SIDE, FIXED_COUNT = 800, 100_000


def by_count(counts: Sequence[int] = COUNTS, report: Report = print) -> dict[str, Any]:
    """Iterations at 800 x 800 with more and smaller Gaussians on the same surface."""
    cases = [Case(f"{FIXED_SIDE}x{FIXED_SIDE}/{count}", FIXED_SIDE, FIXED_SIDE, count) for count in counts]
    fixed = f"{FIXED_SIDE}x{FIXED_SIDE} pixels, 1 thread"
    return series("Gaussians", fixed, [(case.count, case) for case in cases], report)


def by_pixels(sides: Sequence[int] = SIDES, report: Report = print) -> dict[str, Any]:
    """Iterations over the same 100,000 Gaussians at growing resolution."""
    cases = [Case(f"{side}x{side}/{FIXED_COUNT}", side, side, FIXED_COUNT) for side in sides]
    return series("pixels", f"{FIXED_COUNT:,} Gaussians, 1 thread", [(case.width**2, case) for case in cases], report)


def series(what: str, fixed: str, cases: Sequence[tuple[int, Case]], report: Report) -> dict[str, Any]:
    """One record (`schema.GROWTH`). The exponent is fitted to the upper half, where fixed costs are negligible."""
    measure(cases[0][1])  # the first measurement includes allocations that the process keeps
    points = []
    for size, case in cases:
        points.append({"size": size, **measure(case)})
        report(f"{what} {size:,}: {points[-1]['cpu_ms']['median']:.1f} ms")
    upper = points[len(points) // 2 :] if len(points) > 3 else points
    exponent = fitted_exponent([(p["size"], p["cpu_ms"]["median"]) for p in upper])
    return {"what": what, "fixed": fixed, "points": points, "exponent": exponent, "from_size": upper[0]["size"]}


def measure(case: Case) -> dict[str, Any]:
    """CPU time of an iteration, and the memory that the model, its moments, gradients and buffers hold."""
    gc.collect()
    before = resident_mb()
    iteration = Iteration(case, threads=1)
    repetitions = 15 if case.count * case.width * case.height < 1e11 else 5
    readings = repeat(iteration.run, repetitions)
    after = resident_mb()
    memory = None if before is None or after is None else max(round(after - before, 1), 0.0)
    return {"cpu_ms": spread([reading.cpu for reading in readings]), "memory_mb": memory}


def fitted_exponent(points: Sequence[tuple[float, float]]) -> float:
    """k of y = c x^k by least squares on logarithms."""
    xs, ys = ([math.log(point[axis]) for point in points] for axis in (0, 1))
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread_x = sum((x - mean_x) ** 2 for x in xs)
    if spread_x == 0:
        return 0.0
    return round(sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys, strict=True)) / spread_x, 3)
