"""Charts for documents: one SVG with axes, several named series and a legend; nothing is loaded from elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 560, 340
LEFT, RIGHT, TOP, BOTTOM = 64, 150, 34, 46
COLORS = ("#2166ac", "#d6604d", "#4d9221", "#762a83", "#b8860b", "#35978f")
STYLE = (
    "text{font:12px sans-serif;fill:#333}.title{font-weight:bold}.grid{stroke:#ddd}.axis{stroke:#888}"
    "polyline{fill:none;stroke-width:2}svg{background:#fff}"
)


@dataclass(frozen=True)
class Series:
    """Named points, joined by a line when `line` is set."""

    name: str
    points: Sequence[tuple[float, float]]
    line: bool = True


@dataclass(frozen=True)
class Axis:
    """One axis: its label with the unit, and whether its scale is logarithmic."""

    label: str
    log: bool = False

    def span(self, values: Sequence[float]) -> tuple[float, float]:
        """Both ends of the axis: rounded outwards to powers of ten, or with a margin of 6 %."""
        low, high = min(values), max(values)
        if self.log:
            return 10.0 ** math.floor(math.log10(low) + 1e-9), 10.0 ** math.ceil(
                math.log10(high) - 1e-9 + (low == high)
            )
        room = 0.06 * (high - low) or max(abs(high), 1.0) * 0.06
        return low - room, high + room

    def share(self, value: float, span: tuple[float, float]) -> float:
        """Position of a value between both ends, 0 to 1."""
        low, high = span
        if self.log:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)

    def ticks(self, span: tuple[float, float]) -> list[float]:
        low, high = span
        if self.log:
            first, last = round(math.log10(low)), round(math.log10(high))
            step = max(1, (last - first) // 6)
            return [10.0**power for power in range(first, last + 1, step)]
        raw = (high - low) / 5
        power = 10.0 ** math.floor(math.log10(raw))
        width = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= raw)
        return [width * n for n in range(math.ceil(low / width), math.floor(high / width) + 1)]


def chart(title: str, x: Axis, y: Axis, series: Sequence[Series]) -> str:
    """A whole SVG document. Points without a place on a logarithmic axis are left out."""
    kept = [Series(s.name, [p for p in s.points if drawable(p, x, y)], s.line) for s in series]
    kept = [s for s in kept if s.points]
    points = [point for s in kept for point in s.points]
    if not points:
        nothing = f'<text x="8" y="20">{escape(title)}: nothing measured</text>'
        return f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="30">{nothing}</svg>\n'
    spans = x.span([p[0] for p in points]), y.span([p[1] for p in points])

    def place(point: tuple[float, float]) -> tuple[float, float]:
        across = LEFT + (WIDTH - LEFT - RIGHT) * x.share(point[0], spans[0])
        return across, HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * y.share(point[1], spans[1])

    parts = [f'<text class="title" x="{LEFT}" y="20">{escape(title)}</text>']
    for value in x.ticks(spans[0]):
        parts.append(_vertical(place((value, spans[1][0]))[0], short(value)))
    for value in y.ticks(spans[1]):
        parts.append(_horizontal(place((spans[0][0], value))[1], short(value)))
    for index, s in enumerate(kept):
        parts += _drawn(s, [place(point) for point in s.points], COLORS[index % len(COLORS)], index)
    middle = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{middle[0]}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x.label)}</text>')
    turned = f'transform="rotate(-90 14 {middle[1]})" text-anchor="middle"'
    parts.append(f'<text x="14" y="{middle[1]}" {turned}>{escape(y.label)}</text>')
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
    return f'{head}<style>{STYLE}</style><rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>{"".join(parts)}</svg>\n'


def drawable(point: tuple[float, float], x: Axis, y: Axis) -> bool:
    return all(math.isfinite(value) and (value > 0 or not axis.log) for value, axis in zip(point, (x, y), strict=True))


def short(value: float) -> str:
    """A tick's label: 100k, 2M, 1e-6."""
    for limit, suffix in ((1e6, "M"), (1e3, "k")):
        if limit <= abs(value) < 1e9:
            return f"{value / limit:.4g}{suffix}"
    return f"{value:.4g}"


def _drawn(series: Series, places: Sequence[tuple[float, float]], color: str, index: int) -> list[str]:
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    parts = [f'<polyline points="{line}" stroke="{color}"/>'] if series.line and len(places) > 1 else []
    parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>' for x, y in places]
    top = TOP + 10 + 20 * index
    parts.append(f'<circle cx="{WIDTH - RIGHT + 14}" cy="{top - 4}" r="4" fill="{color}"/>')
    parts.append(f'<text x="{WIDTH - RIGHT + 24}" y="{top}">{escape(series.name)}</text>')
    return parts


def _vertical(x: float, label: str) -> str:
    line = f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
    return f'{line}<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{escape(label)}</text>'


def _horizontal(y: float, label: str) -> str:
    line = f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
    return f'{line}<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{escape(label)}</text>'
