"""Progress of synth_views.py, by the images it has written, and the pose of its object in the original scene."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .files import read_json

PARTIAL = ".partial-"
RECORD = "object.json"
LARGEST_ENTRY = 1e30
"""Bound of a matrix entry; Blender's matrices are float32."""


def pictures(out: Path) -> int:
    """Pictures written so far, in finished objects and in those being made."""
    return sum(count_png(folder / "images") for folder in objects(out))


def count_png(folder: Path) -> int:
    try:
        return sum(entry.name.endswith(".png") for entry in os.scandir(folder))
    except OSError:
        return 0


def objects(out: Path) -> list[Path]:
    try:
        return [Path(entry.path) for entry in os.scandir(out) if entry.is_dir()]
    except OSError:
        return []


def finished(out: Path) -> Path | None:
    """The dataset of the one object that was rendered, once it is there."""
    found = [folder for folder in objects(out) if not folder.name.startswith(".") and (folder / RECORD).is_file()]
    return found[0] if found else None


def failure(out: Path) -> str:
    """Why an object could not be rendered; empty where nothing is told."""
    try:
        with open(out / "failures.json", "rb") as file:
            lost = json.loads(file.read(1 << 20))
        return str(lost[0]["reason"])[:500] if lost else ""
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""


def scene_from_dataset(data: Path) -> NDArray[np.float64] | None:
    """Returns [4, 4] from the dataset's frame back to the rendered scene, or None when it is not recorded."""
    if not (data / RECORD).is_file():
        return None
    matrix: Any = read_json(data / RECORD).get("normalized_from_mesh")
    try:
        forward = np.array(matrix, np.float64)
        if forward.shape != (4, 4) or not (np.abs(forward) < LARGEST_ENTRY).all():
            raise ValueError("it is no 4x4 matrix")
        back = np.linalg.inv(forward).astype(np.float64)
        if not (np.abs(back) < LARGEST_ENTRY).all():
            raise ValueError("it has no inverse")
        return back
    except (ValueError, TypeError, OverflowError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"`normalized_from_mesh` of {data / RECORD} cannot be used: {error}. Render it again."
        ) from error
