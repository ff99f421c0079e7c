"""`plan.json`: the cells of a scene, their bounds on the ground, and the views that see them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data import files
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic

VERSION = 1
Pair = tuple[float, float]


@dataclass(frozen=True)
class Cell:
    """A rectangle on the ground and what its run needs."""

    name: str
    """Folder of its run below RUN/cells."""
    low: Pair
    """Least coordinates along both axes of the ground, scene units; -inf where no other cell follows."""
    high: Pair
    margin: Pair
    """Its Gaussians learn that far beyond the bounds; in the result they end there, where those of a neighbor begin."""
    views: tuple[str, ...]
    """Names of the input views that its run learns from."""
    max_gaussians: int

    def holds(self, places: Float[Tensor, "N 2"], wide: bool = False) -> Bool[Tensor, "N"]:
        """True for places within the bounds; `wide`: margin included. Every place is within those of one cell."""
        margin = torch.tensor(self.margin if wide else (0.0, 0.0), dtype=torch.float64)
        low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (self.low, self.high))
        return ((places >= low - margin) & (places < high + margin)).all(dim=1)


@dataclass(frozen=True)
class CellPlan:
    """All cells of a scene."""

    coarse: str
    """SHA-256 of the coarse run's splats."""
    ground: tuple[tuple[float, ...], ...]
    """Two axes of the ground, in the frame of the splats."""
    cells: tuple[Cell, ...]

    def places(self, means: Float[Tensor, "N 3"]) -> Float[Tensor, "N 2"]:
        """Coordinates on the ground."""
        return on_ground(means, torch.tensor(self.ground, dtype=torch.float64))

    def write(self, path: Path) -> None:
        cells = [
            {**vars(cell), "low": _open(cell.low), "high": _open(cell.high), "margin": cell.margin, "views": cell.views}
            for cell in self.cells
        ]
        document = {"version": VERSION, "coarse": self.coarse, "ground": self.ground, "cells": cells}
        write_atomic(path, to_json(document))


def on_ground(means: Float[Tensor, "N 3"], ground: Float[Tensor, "2 3"]) -> Float[Tensor, "N 2"]:
    """Coordinates of points along the axes of the ground."""
    return (means.double()[:, None, :] * ground).sum(2)  # a product of matrices may differ from processor to processor


def read_plan(path: Path, coarse: Path, names: Mapping[str, Any], count: int) -> CellPlan:
    """The plan in `path`, which must be that of the coarse run `coarse`, in `count` cells, with views from `names`.

    Raises InputError, for a run directory may come from a stranger.
    """
    document = files.read_json(path)
    try:
        if document["version"] != VERSION:
            raise ValueError(f"version {document['version']} instead of {VERSION}")
        cells = [_cell(number, row) for number, row in enumerate(document["cells"])]
        plan = CellPlan(str(document["coarse"]), tuple(_numbers(axis, 3) for axis in document["ground"]), tuple(cells))
        views = {name for cell in cells for name in cell.views}
        if plan.coarse != sha256(coarse) or len(cells) != count or len(plan.ground) != 2 or not views <= set(names):
            raise ValueError("it is that of another run")
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:
        raise InputError(f"{path} does not fit this run: {error}. Remove it, or choose another folder.") from error
    return plan


def sha256(path: Path) -> str:
    """Hash of a file."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror}. Start in another folder.") from error


def _cell(number: int, row: dict[str, Any]) -> Cell:
    low, high = (_bound(row[side], sign) for side, sign in (("low", -math.inf), ("high", math.inf)))
    views, budget = row["views"], row["max_gaussians"]
    if type(budget) is not int or budget < 1 or not isinstance(views, list) or not views:
        raise ValueError(f"cell {number} has no views or Gaussians")
    first, second = _numbers(row["margin"], 2)
    return Cell(f"{number:02d}", low, high, (first, second), tuple(map(str, views)), budget)


def _open(bound: Pair) -> list[float | None]:
    """A bound as JSON has it, which knows no infinity."""
    return [None if math.isinf(value) else value for value in bound]


def _bound(values: Any, open_end: float) -> Pair:
    first, second = _numbers([open_end if value is None else value for value in values], 2)
    return first, second


def _numbers(values: Any, count: int) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)
    if len(numbers) != count or any(math.isnan(value) for value in numbers):
        raise ValueError(f"{count} numbers are needed, got {len(numbers)}")
    return numbers
