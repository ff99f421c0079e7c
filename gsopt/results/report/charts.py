"""Line charts as inline SVG, colored by the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 360, 210
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 14, 36
MAX_POINTS = 300
MIN_LOG_VALUE = 1e-300
"""Least value on a logarithmic axis, so that no tick is 0."""
MIN_RANGE = 1e-300
"""Values that differ by less count as one: a fraction of the difference may be 0."""


def line_chart(title: str, points: Sequence[tuple[float, float]], *, log: bool = False, unit: str = "") -> str:
    """A figure with axes, the line and its last value. Fewer than two points give a sentence instead.

    `log`: logarithmic vertical axis; points at or below MIN_LOG_VALUE are left out.
    """
    points = [point for point in points if not log or point[1] > MIN_LOG_VALUE]
    if len(points) < 2:
        return (
            f'<figure class="chart"><figcaption>{escape(title)}</figcaption><p class="muted">Not recorded.</p></figure>'
        )
    points = thinned(points)
    x_ticks = ticks(0, points[-1][0], 4)
    low, high = min(y for _, y in points), max(y for _, y in points)
    y_ticks = log_ticks(low, high) if log else ticks(low, high, 4)
    low, high = min(low, y_ticks[0]), max(high, y_ticks[-1])

    def x_of(value: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * value / max(x_ticks[-1], points[-1][0])

    def y_of(value: float) -> float:
        scale = math.log if log else float
        share = (scale(value) - scale(low)) / (scale(high) - scale(low)) if high > low else 0.5
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share

    grid = [_horizontal(y_of(value), short(value)) for value in y_ticks]
    grid += [_below(x_of(value), short(value)) for value in x_ticks]
    line = " ".join(f"{x_of(x):.1f},{y_of(y):.1f}" for x, y in points)
    last_x, last_y = x_of(points[-1][0]), y_of(points[-1][1])
    label = f"{short(points[-1][1])}{unit}"
    return (
        f'<figure class="chart"><figcaption>{escape(title)} <b>{escape(label)}</b></figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}, at the end {escape(label)}">'
        f'{"".join(grid)}<polyline class="line" points="{line}"/>'
        f'<circle class="dot" cx="{last_x:.1f}" cy="{last_y:.1f}" r="3.5"/>'
        f'<text class="tick" x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" text-anchor="end">step</text></svg></figure>'
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """About `count` + 1 round values whose range covers low..high: multiples of 1, 2 or 5 times a power of ten."""
    if not high - low > MIN_RANGE:
        low, high = low - max(abs(low), 1) * 0.05, high + max(abs(high), 1) * 0.05
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(index * step, 12) for index in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten that cover low..high; every other one where there are many."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    values = [factor * 10.0**power for power in powers for factor in (1, 2, 5)]
    first = max((i for i, value in enumerate(values) if value <= low * (1 + 1e-9)), default=0)
    last = min((i for i, value in enumerate(values) if value >= high * (1 - 1e-9)), default=len(values) - 1)
    return values[first : max(last, first + 1) + 1 : max(1, (last - first) // 5)]


def thinned(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most about MOST_POINTS points: means over runs of equal length, the last point as it is."""
    run = math.ceil(len(points) / MAX_POINTS)
    groups = [points[start : start + run] for start in range(0, len(points) - 1, run)]
    means = [(sum(x for x, _ in group) / len(group), sum(y for _, y in group) / len(group)) for group in groups]
    return [*(means if run > 1 else points[:-1]), points[-1]]


def short(value: float) -> str:
    """At most four significant digits; thousands as k, millions as M."""
    for limit, suffix in ((1e6, "M"), (1e4, "k")):
        if abs(value) >= limit:
            return f"{value / (1e6 if suffix == 'M' else 1e3):.4g}{suffix}"
    return f"{value:.4g}"


def _horizontal(y: float, label: str) -> str:
    return (
        f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text class="tick" x="{LEFT - 7}" y="{y + 3.5:.1f}" text-anchor="end">{escape(label)}</text>'
    )


def _below(x: float, label: str) -> str:
    return f'<text class="tick" x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{escape(label)}</text>'
