"""Statistics over the runs of a suite: means over scenes, paired differences with intervals, time to a quality."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsopt.benchmark.suite import arm_flags

CONFIDENCE = 0.95

Run = Mapping[str, Any]
Variant = tuple[str, int]
"""Arm and number of steps."""


@dataclass(frozen=True)
class Difference:
    """Difference of two variants in one metric over the same scenes."""

    mean: float
    half: float | None
    """Half width of the confidence interval, or None for a single value."""
    lowest: float
    highest: float
    positive: int
    """Number of scenes (or of seeds of a single scene) with a difference above 0."""
    count: int


def variant(run: Run) -> Variant:
    return run["arm"], run["iterations"]


def by_scene(runs: Sequence[Run], metric: str) -> dict[str, float]:
    """Mean over seeds; scenes where some run lacks the metric are left out."""
    found: dict[str, list[float | None]] = {}
    for run in runs:
        found.setdefault(run["scene"], []).append(run["mean"][metric])
    known = {scene: [v for v in values if v is not None] for scene, values in found.items()}
    return {scene: statistics.fmean(values) for scene, values in known.items() if len(values) == len(found[scene])}


def differences(runs: Sequence[Run], a: Variant, b: Variant, metric: str) -> list[float]:
    """Values of a minus b, paired by scene and seed: one per scene, because seeds of one scene are not independent and
    are averaged first, or one per seed when there is a single scene."""
    others = {(run["scene"], run["seed"]): run["mean"][metric] for run in runs if variant(run) == b}
    pairs: dict[str, list[float]] = {}
    for run in runs:
        other = others.get((run["scene"], run["seed"]))
        if variant(run) == a and other is not None and run["mean"][metric] is not None:
            pairs.setdefault(run["scene"], []).append(run["mean"][metric] - other)
    if len(pairs) == 1:
        return next(iter(pairs.values()))
    return [statistics.fmean(values) for values in pairs.values()]


def summarized(values: Sequence[float]) -> Difference | None:
    """Mean and Student's confidence interval, or None without values."""
    if not values:
        return None
    mean, half = statistics.fmean(values), None
    if len(values) > 1:
        error = statistics.stdev(values) / math.sqrt(len(values))
        half = t_quantile(0.5 + CONFIDENCE / 2, len(values) - 1) * error
    return Difference(mean, half, min(values), max(values), sum(value > 0 for value in values), len(values))


def t_probability(t: float, degrees: int) -> float:
    """P(|T| < t) of Student's t with whole degrees of freedom (Abramowitz & Stegun 26.7.3 and 26.7.4)."""
    theta = math.atan(t / math.sqrt(degrees))
    cos, sin = math.cos(theta), math.sin(theta)
    odd = degrees % 2
    term, total = (cos if odd else 1.0), 0.0
    for k in range(1 + odd, degrees, 2):
        total += term
        term *= cos * cos * k / (k + 1)
    return 2 / math.pi * (theta + sin * total) if odd else sin * total


def t_quantile(p: float, degrees: int) -> float:
    """t with P(T < t) = p, p from 1/2 up, by bisection."""
    low, high = 0.0, 1e6
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if 0.5 + t_probability(middle, degrees) / 2 < p else (low, middle)
    return high


def seconds_to_psnr(curve: Sequence[Mapping[str, Any]], psnr: float) -> float | None:
    """CPU seconds until a run reaches that PSNR, linear between two evaluations, or None when it never does."""
    before: Mapping[str, Any] | None = None
    for point in curve:
        if point["psnr"] >= psnr:
            if before is None:
                return float(point["cpu_seconds"])
            share = (psnr - before["psnr"]) / (point["psnr"] - before["psnr"])
            return float(before["cpu_seconds"] + share * (point["cpu_seconds"] - before["cpu_seconds"]))
        before = point
    return None


def times_to_match(runs: Sequence[Run], a: Variant, base: Variant) -> tuple[list[float], int]:
    """(CPU seconds of the runs of `a` that reach the final PSNR of the paired run of `base`, number of pairs), by the
    views of the curve."""
    goals = {(run["scene"], run["seed"]): run["curve"][-1]["psnr"] for run in runs if variant(run) == base}
    pairs = [run for run in runs if variant(run) == a and (run["scene"], run["seed"]) in goals]
    times = [seconds_to_psnr(run["curve"], goals[run["scene"], run["seed"]]) for run in pairs]
    return [time for time in times if time is not None], len(pairs)


def mean_curve(runs: Sequence[Run], metric: str) -> list[tuple[float, float]]:
    """(CPU seconds, metric) at each evaluated step, both averaged over runs; steps that some run lacks are left out."""
    means = []
    for step in sorted({point["step"] for run in runs for point in run["curve"]}):
        points = [p for run in runs for p in run["curve"] if p["step"] == step and p[metric] is not None]
        if len(points) == len(runs):
            seconds = statistics.fmean(point["cpu_seconds"] for point in points)
            means.append((seconds, statistics.fmean(point[metric] for point in points)))
    return means


def complete(runs: Sequence[Run], variants: Sequence[Variant]) -> list[Variant]:
    """`variants` without prompted arms that lack a scene or seed: a language model may have no prompt for a scene."""
    made = {one: {(run["scene"], run["seed"]) for run in runs if variant(run) == one} for one in variants}
    every = set().union(*made.values())
    return [one for one in variants if one[0] not in arm_flags.PROMPT_SOURCES or made[one] == every]


def common(runs: Sequence[Run], variants: Sequence[Variant]) -> list[Run]:
    """The runs of those scenes and seeds that every one of `variants` has."""
    keys = [{(run["scene"], run["seed"]) for run in runs if variant(run) == one} for one in variants]
    kept = set.intersection(*keys) if keys else set()
    return [run for run in runs if (run["scene"], run["seed"]) in kept and variant(run) in variants]
