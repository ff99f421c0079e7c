"""Scale and origin of a scene, as files of splats and meshes carry them.

PLY: comments `Meters per unit: S` and `Origin: X Y Z`; .glb: `extras` of the node; .sog and USD: `gsopt` in meta.json
and in the layer. A position p of the file lies at origin + p in the source's coordinates, and its lengths times S are
meters. Notes that cannot be read count as absent: they are no reason to refuse splats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsopt.formats.files import opened

SCALE, ORIGIN = "meters_per_unit", "origin"
_SCALE_COMMENT, _ORIGIN_COMMENT = "meters per unit:", "origin:"
Point = tuple[float, float, float]
NOWHERE: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Units:
    """The meaning of the coordinates of a file."""

    meters_per_unit: float | None = None
    """Is None where no length is known."""
    origin: Point = NOWHERE
    """Subtracted from every position of the source, source units."""

    def comments(self) -> list[str]:
        """Lines for the header of a PLY."""
        scale = [] if self.meters_per_unit is None else [f"Meters per unit: {self.meters_per_unit!r}"]
        return scale + ([f"Origin: {' '.join(map(repr, self.origin))}"] if self.origin != NOWHERE else [])

    def notes(self) -> dict[str, Any]:
        """The same as a JSON object, empty when there is nothing to note."""
        scale = {} if self.meters_per_unit is None else {SCALE: self.meters_per_unit}
        return scale | ({ORIGIN: list(self.origin)} if self.origin != NOWHERE else {})


UNKNOWN = Units()


def units_from_notes(notes: Any) -> Units:
    """Inverse of `Units.notes`, for an object that may hold anything."""
    if not isinstance(notes, dict):
        return UNKNOWN
    origin = notes.get(ORIGIN)
    found = tuple(_number(value) for value in origin) if isinstance(origin, list) and len(origin) == 3 else ()
    x, y, z = found if found and None not in found else NOWHERE
    scale = _number(notes.get(SCALE))
    return Units(scale if scale is not None and scale > 0 else None, (x or 0.0, y or 0.0, z or 0.0))


def units_from_comments(comments: Iterable[str]) -> Units:
    """Inverse of `Units.comments`."""
    notes: dict[str, Any] = {}
    for comment in comments:
        text = comment.strip().lower()
        if text.startswith(_SCALE_COMMENT):
            notes[SCALE] = _parsed(text.removeprefix(_SCALE_COMMENT))
        if text.startswith(_ORIGIN_COMMENT):
            notes[ORIGIN] = [_parsed(word) for word in text.removeprefix(_ORIGIN_COMMENT).split()]
    return units_from_notes(notes)


def read_units(path: Path) -> Units:
    """The notes of a splat file; unknown for formats that carry none."""
    suffix = path.suffix.lower()
    if suffix == ".ply":
        from gsopt.formats.ply_header import read_header

        with opened(path) as (file, _):
            return units_from_comments(read_header(file, path).comments)
    if suffix == ".glb":
        from gsopt.formats.glb_container import read_container

        with opened(path) as (file, size):
            document = read_container(file, size, path)
            nodes = [units_from_notes(node.get("extras")) for node in document.objects(document.root, "nodes")]
            return next((units for units in nodes if units != UNKNOWN), UNKNOWN)
    if suffix == ".sog":
        from gsopt.formats.sog import sog_meta

        return units_from_notes(sog_meta(path).get("gsopt"))
    if suffix in (".usda", ".usdc"):
        from gsopt.formats.usd import usd_units

        return usd_units(path)
    return UNKNOWN


def _number(value: Any) -> float | None:
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e300:
        return None
    return float(value) if math.isfinite(value) else None


def _parsed(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
