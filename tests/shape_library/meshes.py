"""Meshes of known shape, as OBJ files; z is up in the arguments, y in the files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (1, 5, 7, 3), (0, 2, 6, 4))
"""The lowest last."""

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Middle and half sides."""


def write_boxes(path: Path, boxes: list[Box], *, open_below: bool = False) -> Path:
    """Boxes as one mesh; without their floors when `open_below`."""
    lines, first = [], 1
    for middle, half in boxes:
        for x, y, z in CORNERS * half + middle:
            lines.append(f"v {x} {z} {-y}")
        for face in FACES[: 5 if open_below else 6]:
            lines.append("f " + " ".join(str(first + corner) for corner in face))
        first += 8
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def tower(half: float = 0.3) -> list[Box]:
    return [((0.0, 0.0, 0.0), (half, half, 1.0))]


def table() -> list[Box]:
    """A top on four thick legs."""
    legs = [((x, y, -0.2), (0.12, 0.12, 0.4)) for x in (-0.8, 0.8) for y in (-0.5, 0.5)]
    return [((0.0, 0.0, 0.3), (1.0, 0.7, 0.1)), *legs]


def slab() -> list[Box]:
    return [((0.0, 0.0, 0.0), (1.0, 0.15, 0.8))]


def library_folder(folder: Path) -> Path:
    """Three kinds of things, one described by a text beside it."""
    write_boxes(folder / "tables" / "oak_table.obj", table())
    write_boxes(folder / "towers" / "tower.obj", tower())
    write_boxes(folder / "0f3a.obj", slab())
    (folder / "0f3a.txt").write_text("a street sign", encoding="utf-8")
    return folder


def listed(folder: Path, rows: list[dict[str, object]]) -> Path:
    path = folder / "library.json"
    path.write_text(json.dumps(rows), encoding="utf-8")
    return path
