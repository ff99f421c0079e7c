"""Divides a scene into cells by what its input views see of a coarse model.

The cells are the leaves of a k-d tree over the ground (Bentley 1975) with equal numbers of the Gaussians that views
see, since that is what memory goes by. As in VastGaussian (Lin et al. 2024) a cell learns from the views in which
enough of the image is its own, and overlaps its neighbors; here its share are the pixels that its Gaussians draw.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.scene import View
from gsopt.errors import InputError
from gsopt.gaussians import Gaussians
from gsopt.geometry.focus import up_direction
from gsopt.raster.backend import Backend
from gsopt.raster.threads import one_torch_thread
from gsopt.results.clean import SEEN, pixel_sums
from gsopt.training.cells.plan import Cell, CellPlan, Pair, on_ground

MARGIN = 0.1
"""Overlap on each inner side, as a share of the narrowest cell."""
RELEVANT = 0.05
"""Share of a view's drawn pixels from which on it belongs to a cell."""
FEWEST_VIEWS = 8
"""A cell has the views with the largest shares, at least so many where there are."""
TAIL = 0.05
"""Share of the Gaussians at either end that do not count for the size of a cell: the far background."""


@dataclass(frozen=True)
class Division:
    """A plan, and the coarse Gaussians outside each cell that its views see."""

    plan: CellPlan
    surroundings: tuple[Bool[Tensor, "N"], ...]


@one_torch_thread()
def divide(
    coarse: Gaussians, sha: str, views: Sequence[View], backend: Backend, count: int, max_gaussians: int
) -> Division:
    """Cells for `max_gaussians` in all."""
    seen = sum(_weights(coarse, views, backend), torch.zeros(len(coarse))) > SEEN
    ground = ground_axes(views)
    places = on_ground(coarse.means, ground)
    boxes = split(places[seen], count)
    sides = torch.stack([_side(places[seen & Cell("", *box, (0.0, 0.0), (), 0).holds(places)]) for box in boxes])
    first, second = (MARGIN * sides.amin(0)).tolist()
    empty = [Cell(f"{n:02d}", *box, (first, second), (), 0) for n, box in enumerate(boxes)]
    wide = torch.stack([cell.holds(places, wide=True) for cell in empty])
    shares = torch.stack([_shares(weights, wide) for weights in _weights(coarse, views, backend)])
    chosen = [relevant(shares[:, row]) for row in range(count)]
    outside = [torch.zeros(len(coarse), dtype=torch.bool) for _ in empty]
    for number, weights in enumerate(_weights(coarse, views, backend)):
        for row in range(count):
            if chosen[row][number]:
                outside[row] |= (weights > 0) & ~wide[row]
    cells = tuple(
        Cell(
            cell.name, cell.low, cell.high, cell.margin,
            tuple(view.name for view, mine in zip(views, chosen[row].tolist(), strict=True) if mine),
            math.ceil(max_gaussians * int(wide[row].sum()) / len(coarse)),
        )
        for row, cell in enumerate(empty)
    )  # fmt: skip
    return Division(CellPlan(sha, tuple(tuple(axis) for axis in ground.tolist()), cells), tuple(outside))


def ground_axes(views: Sequence[View]) -> Float[Tensor, "2 3"]:
    """Two directions at right angles to the cameras' common up, the first as near to a world axis as can be."""
    up = up_direction(torch.cat([view.camera.viewmats for view in views]))
    axis = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    first = axis - (axis @ up) * up
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(up, first)])


def split(places: Float[Tensor, "N 2"], count: int) -> list[tuple[Pair, Pair]]:
    """Low and high bounds of `count` rectangles that cover the plane and hold equally many of the places."""
    return list(_split(places, count, (-math.inf, -math.inf), (math.inf, math.inf)))


def _split(places: Float[Tensor, "N 2"], count: int, low: Pair, high: Pair) -> Iterator[tuple[Pair, Pair]]:
    if count == 1:
        yield low, high
        return
    first = count // 2
    axis = int(_side(places).argmax()) if len(places) else 0
    ordered = places[:, axis].sort().values
    at = float(ordered[len(ordered) * first // count]) if len(ordered) else 0.0
    below = places[:, axis] < at
    if not 0 < int(below.sum()) < len(places):
        raise InputError("The coarse model is too small for so many cells. Lower --cells, or leave it out.")
    middle = [(at, bound[1]) if axis == 0 else (bound[0], at) for bound in (low, high)]
    yield from _split(places[below], first, low, middle[1])
    yield from _split(places[~below], count - first, middle[0], high)


def _side(places: Float[Tensor, "N 2"]) -> Float[Tensor, "2"]:
    """Width of at least one place along both axes, without the farthest."""
    ordered = places.sort(dim=0).values
    margin = int(TAIL * len(ordered))
    return ordered[-1 - margin] - ordered[margin]


def _weights(coarse: Gaussians, views: Sequence[View], backend: Backend) -> Iterator[Float[Tensor, "N"]]:
    """The sum over each view's pixels of T alpha of every Gaussian."""
    for view in views:
        ones = torch.ones(view.camera.height, view.camera.width, 2)
        with torch.enable_grad():
            yield pixel_sums(coarse, view, backend, ones)[0][:, 0]


def _shares(weights: Float[Tensor, "N"], wide: Bool[Tensor, "C N"]) -> Float[Tensor, "C"]:
    """Share of what a view draws that each cell's Gaussians do."""
    weights = weights.double()
    return (wide * weights).sum(1) / weights.sum().clamp_min(1e-9)


def relevant(shares: Float[Tensor, "V"]) -> Bool[Tensor, "V"]:
    """The views of a cell by its share in each."""
    chosen = shares >= RELEVANT
    if int(chosen.sum()) < FEWEST_VIEWS:
        chosen = torch.zeros_like(chosen)
        chosen[shares.argsort(descending=True, stable=True)[:FEWEST_VIEWS]] = True
    return chosen
