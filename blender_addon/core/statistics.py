"""Statistics of splats for the Inspect panel, and the splats that its filters keep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .splats import Floats, Splats

BINS = 10
SAMPLE = 100_000
"""Rows, evenly chosen, that a median is taken of: a million of them would cost ten milliseconds each."""
FAR = 6.0
"""An outlier lies farther from the median position than this many times the median distance."""
LARGE = 20.0
"""An outlier is larger than this many times the median size."""


class Shapes(Protocol):
    """Filters look at these three; a mesh reads each only when it is asked for."""

    @property
    def positions(self) -> Floats: ...
    @property
    def scales(self) -> Floats: ...
    @property
    def opacities(self) -> Floats: ...


@dataclass(frozen=True)
class Bar:
    """One bin of a histogram."""

    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Summary:
    """Statistics of a set of splats."""

    count: int
    sh_degree: int
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    median_size: float
    opacities: tuple[Bar, ...]
    sizes: tuple[Bar, ...]
    """Geometric mean of the three scales, bins equal in the logarithm."""
    outliers: int
    left_out: int = 0
    """Rows of the file that cannot be drawn."""


def sizes(splats: Splats) -> NDArray[np.float32]:
    """[N] geometric mean of the three scales."""
    size: NDArray[np.float32] = np.cbrt(splats.scales.prod(axis=1, dtype=np.float64)).astype(np.float32)
    return size


def largest_scales(splats: Shapes) -> Floats:
    """[N] standard deviation along the longest axis. Column by column: numpy is slow along short rows."""
    x, y, z = splats.scales.T
    longest: Floats = np.maximum(np.maximum(x, y), z)
    return longest


def squared_distances(positions: Floats, center: Any) -> Floats:
    """[N] squared distance to a point."""
    offset = positions - np.asarray(center, np.float32)
    squared: Floats = np.einsum("ij,ij->i", offset, offset)
    return squared


def outliers(splats: Shapes) -> NDArray[np.bool_]:
    """[N] far from the rest, or far larger."""
    largest = largest_scales(splats)
    if not len(largest):
        return np.zeros(0, bool)
    rows = slice(None, None, -(-len(largest) // SAMPLE))
    squared = squared_distances(splats.positions, np.median(splats.positions[rows], axis=0))
    far: NDArray[np.bool_] = squared > FAR**2 * max(float(np.median(squared[rows])), 1e-24)
    large: NDArray[np.bool_] = largest > LARGE * max(float(np.median(largest[rows])), 1e-12)
    return far | large


def summary(splats: Splats) -> Summary:
    """Counts, extent and histograms; zeros where there are no splats."""
    if not len(splats):
        return Summary(0, splats.sh_degree, (0, 0, 0), (0, 0, 0), 0.0, (), (), 0)
    size = np.maximum(sizes(splats), 1e-30).astype(np.float64)  # rounded to float32, an end could fall off its bin
    low, high = np.quantile(np.log10(size), (0.001, 0.999))
    edges = 10 ** np.linspace(low, max(high, low + 0.01), BINS + 1)
    return Summary(
        count=len(splats),
        sh_degree=splats.sh_degree,
        low=tuple(splats.positions.min(axis=0).tolist()),
        high=tuple(splats.positions.max(axis=0).tolist()),
        median_size=float(np.median(size)),
        opacities=bars(splats.opacities, np.linspace(0, 1, BINS + 1)),
        sizes=bars(np.clip(size, edges[0], edges[-1]), edges),
        outliers=int(outliers(splats).sum()),
        left_out=splats.left_out,
    )


def bars(values: Any, edges: Any) -> tuple[Bar, ...]:
    counts, edges = np.histogram(values, edges)
    return tuple(Bar(float(a), float(b), int(n)) for a, b, n in zip(edges, edges[1:], counts, strict=False))


@dataclass(frozen=True)
class Filter:
    """Limits of the splats that are kept; no limit binds where the value is None."""

    opacity: tuple[float, float] = (0.0, 1.0)
    largest_scale: float | None = None
    """Scene units, of the longest axis."""
    farthest: float | None = None
    """From `center`, scene units."""
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    box_from_local: NDArray[np.float64] | None = None
    """[4, 4] brings the splats' frame into that of a cube from -1 to 1."""
    without_outliers: bool = False

    def keeps(self, splats: Shapes) -> NDArray[np.bool_]:
        """[N] which splats pass."""
        low, high = self.opacity
        kept = (splats.opacities >= low) & (splats.opacities <= high)
        if self.largest_scale is not None:
            kept &= largest_scales(splats) <= self.largest_scale
        if self.farthest is not None:
            kept &= squared_distances(splats.positions, self.center) <= np.float32(self.farthest) ** 2
        if self.box_from_local is not None:
            matrix = self.box_from_local.astype(np.float32)
            kept &= (np.abs(matrix[:3, :3] @ splats.positions.T + matrix[:3, 3:]) <= 1).all(axis=0)
        if self.without_outliers:
            kept &= ~outliers(splats)
        return kept
