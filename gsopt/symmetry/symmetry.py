"""A symmetry that an object has, and what it makes of a photo."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch

from gsopt.data.scene import View
from gsopt.errors import InputError
from gsopt.geometry.voxels import Grid
from gsopt.init.hull import in_hull
from gsopt.init.thumbnails import Thumbnail
from gsopt.symmetry.axis import Axis
from gsopt.symmetry.mirror import Mirror

MAX_DISAGREEMENT = 0.45
"""Colors of mirror images count if they disagree by no more than this."""
MIRRORED_COLOR_WEIGHT = 0.3
"""Weight of their colors then: light falls on one side, and where a photo shows a point, the photo decides.
docs/decisions/0002-symmetry.md has the figures."""
MAX_TURNS = 64
"""Turns of an axis in a record."""


@dataclass(frozen=True)
class Symmetry:
    """A symmetry that an object has."""

    element: Mirror | Axis
    misses: float
    """Root mean square distance by which the outlines miss, in radii of the object as the photos show it."""
    disagreement: float
    """Disagreement of the colors: 0 for equal images, 1 as between random points."""

    @property
    def colored(self) -> bool:
        """True when the paint is symmetric too."""
        return self.disagreement <= MAX_DISAGREEMENT

    @property
    def about(self) -> str:
        """One line for logs and reports."""
        used = "shape and colors" if self.colored else "shape alone: the colors are not symmetric"
        if isinstance(self.element, Axis):
            x, y, z = self.element.point.tolist()
            return f"{self.element.turns} turns about an upright axis at ({x:.3g}, {y:.3g}, {z:.3g}), {used}"
        x, y, z = self.element.normal.tolist()
        return f"mirror plane ({x:.3f}, {y:.3f}, {z:.3f}) · x = {self.element.offset:.3g}, {used}"

    def images(self, view: View, color: float) -> list[View]:
        """The views of the cameras behind the mirror, or turned about the axis, with this weight of their colors."""
        if isinstance(self.element, Mirror):
            camera = self.element.camera(view.camera)
            return [replace(view, name=f"{view.name} (mirrored)", camera=camera, mirrored=True, color=color)]
        cameras = self.element.cameras(view.camera)
        return [replace(view, name=f"{view.name} (turned)", camera=camera, color=color) for camera in cameras]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; `from_dict` is its inverse, to the bit."""
        own: dict[str, Any]
        if isinstance(self.element, Mirror):
            own = {"normal": self.element.normal.tolist(), "offset": self.element.offset}
        else:
            own = {"direction": self.element.direction.tolist(), "point": self.element.point.tolist()}
            own["turns"] = self.element.turns
        return {**own, "misses": self.misses, "disagreement": self.disagreement, "about": self.about}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Symmetry:
        """KeyError, TypeError, ValueError or InputError for values that `to_dict` never writes."""
        element = _axis(values) if "turns" in values else _mirror(values)
        return Symmetry(element, float(values["misses"]), float(values["disagreement"]))


def _mirror(values: dict[str, Any]) -> Mirror:
    normal, offset = _numbers(values["normal"]), float(values["offset"])
    if not _is_unit(normal) or not math.isfinite(offset):
        raise InputError(f"the plane: normal {normal.tolist()}, offset {offset}")
    return Mirror(normal, offset)


def _axis(values: dict[str, Any]) -> Axis:
    direction, point, turns = _numbers(values["direction"]), _numbers(values["point"]), values["turns"]
    whole = type(turns) is int and 2 <= turns <= MAX_TURNS
    if not _is_unit(direction) or len(point) != 3 or not bool(point.isfinite().all()) or not whole:
        raise InputError(f"the axis: direction {direction.tolist()}, point {point.tolist()}, turns {turns!r:.20}")
    return Axis(direction, point, turns)


def _numbers(values: Any) -> torch.Tensor:
    return torch.tensor([float(number) for number in values])


def _is_unit(vector: torch.Tensor) -> bool:
    return len(vector) == 3 and abs(float(vector.norm()) - 1) < 1e-4


def symmetric_part(grid: Grid, photos: list[Thumbnail], element: Mirror | Axis) -> Grid:
    """The voxels whose images every photo admits."""
    stays = torch.stack([in_hull(photos, image) for image in element.images(grid.centers())]).all(0)
    return replace(grid, occupied=grid.occupied.masked_scatter(grid.occupied, stays))
