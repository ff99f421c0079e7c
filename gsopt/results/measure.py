"""Lengths in a reconstruction: between two points of the scene, or between what two pixels of input views show.

One known length gives the scale, kept as RUN/units.json, which exports and the panel read.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data import files
from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import View, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import refuse_links, to_json, write_atomic
from gsopt.formats.units import Units, read_units, units_from_notes
from gsopt.raster.threads import one_torch_thread
from gsopt.results.finished_run import FinishedRun, open_run
from gsopt.results.mesh.median_depth import depth_view

UNITS_FILE = "units.json"
VERSION = 1
METERS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "in": 0.0254, "ft": 0.3048}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = re.compile(rf"({_NUMBER}),({_NUMBER}),({_NUMBER})")
_PIXEL = re.compile(rf"(.+)@({_NUMBER}),({_NUMBER})")
_LENGTH = re.compile(rf"({_NUMBER})\s*([a-z]+)")
_NAMED_VIEWS = 5


def units_of(source: Path) -> Units:
    """Scale and origin of a run, or those that a splat file carries. InputError for a broken units.json."""
    run = source if source.is_dir() else source.parent
    if not source.is_dir() and (source.name != "splat.ply" or not (run / "config.json").is_file()):
        return read_units(source)
    origin = files.read_json(run / "config.json").get("origin") if (run / "config.json").is_file() else None
    return Units(_scale(run / UNITS_FILE), units_from_notes({"origin": origin}).origin)


def _scale(path: Path) -> float | None:
    if not files.is_regular(path):
        return None
    found = units_from_notes(files.read_json(path))
    if found.meters_per_unit is None:
        raise InputError(f"{path} must name meters_per_unit, a number above 0. Remove it, or measure again.")
    return found.meters_per_unit


@dataclass(frozen=True)
class Length:
    """A distance in a run."""

    units: float
    """Scene units."""
    meters: float | None
    """A known scale of the run gives them, else None."""


def measure(run: Path | str | FinishedRun, start: str, end: str, unit_length: str = "") -> Length:
    """The distance between two points of a run, each `X,Y,Z` or `VIEW@COLUMN,ROW`: what that pixel of a view shows.

    `unit_length`, as `0.25m`: the true distance; RUN/units.json keeps the scale that follows, for exports and Blender.
    """
    length = meters(unit_length) if unit_length else None
    opened = run if isinstance(run, FinishedRun) else open_run(Path(run))
    units, found = units_of(opened.path), distance(opened, start, end)
    if length is not None:
        refuse_links(opened.path)
        units = record_scale(opened.path, length, start, end, found)
    return Length(found, None if units.meters_per_unit is None else found * units.meters_per_unit)


def distance(run: FinishedRun, start: str, end: str) -> float:
    """Distance between two points in scene units; each is `X,Y,Z`, or `VIEW@COLUMN,ROW` for what a pixel shows."""
    a, b = located(run, start), located(run, end)
    return float((a.double() - b.double()).norm())


def located(run: FinishedRun, text: str) -> Float[Tensor, "3"]:
    """The point in the scene that a text names. UsageError where it names none."""
    if match := _POINT.fullmatch(text.strip()):
        return torch.tensor([float(word) for word in match.groups()])
    if match := _PIXEL.fullmatch(text.strip()):
        return lifted(run, _view(run, match[1]), float(match[2]), float(match[3]))
    raise UsageError(
        f"A point must be X,Y,Z in scene units or VIEW@COLUMN,ROW in pixels, got {text!r}. "
        "Write for instance --from=-0.5,0,1.2 or --from r_3@120,85."
    )


@one_torch_thread()
def lifted(run: FinishedRun, view: View, column: float, row: float) -> Float[Tensor, "3"]:
    """The surface point (median depth) that a pixel of a view shows."""
    camera = view.camera
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise UsageError(
            f"{view.name} has {camera.width} x {camera.height} px, got {column:g},{row:g}. Name a pixel inside it."
        )
    depths = run.gaussians.means @ camera.viewmats[0, 2, :3] + camera.viewmats[0, 2, 3]
    ahead = depths[depths > run.settings.near_plane]
    if len(ahead) == 0:
        raise UsageError(f"{view.name} sees no splats. Choose another view.")
    seen = depth_view(run.gaussians, camera, run.backend, run.settings, float(ahead.min()), float(ahead.max()))
    depth = float(seen.depths[int(row), int(column)])
    if math.isinf(depth):
        raise UsageError(f"{view.name} shows no surface at {column:g},{row:g}. Choose a pixel of the object.")
    ray = torch.linalg.inv(camera.Ks[0].double()) @ torch.tensor([column, row, 1.0], dtype=torch.float64)
    world_from_cam = torch.linalg.inv(camera.viewmats[0].double())
    return (world_from_cam[:3, :3] @ (depth * ray) + world_from_cam[:3, 3]).float()


def _view(run: FinishedRun, name: str) -> View:
    """The view of that path or file name, with or without suffix; an input view rather than a held-out one."""
    scene = with_refined_poses(load_scene(run.config.data), run.path)
    for views in (scene.train, scene.test):
        found = [view for view in views if name in (view.name, Path(view.name).name, Path(view.name).stem)]
        if len(found) == 1:
            return found[0]
    names = ", ".join(view.name for view in scene.train[:_NAMED_VIEWS])
    raise UsageError(f"{name!r} must name one view by its path or file name. There are {names}, ...")


def meters(text: str) -> float:
    """`0.25m`, `25 cm`, `10in` in meters."""
    match = _LENGTH.fullmatch(text.strip().lower())
    if match is None or match[2] not in METERS or not 0 < float(match[1]) < 1e12:
        raise UsageError(
            f"A length must be a number above 0 with one of {', '.join(METERS)}, got {text!r}. Write it as 0.25m."
        )
    return float(match[1]) * METERS[match[2]]


def record_scale(run: Path, length: float, start: str, end: str, units: float) -> Units:
    """Write units.json: `units` of the scene between two points are `length` meters."""
    if not 0 < units < math.inf:
        raise UsageError("The two points must lie apart, they are the same. Choose two others.")
    found = Units(length / units, units_of(run).origin)
    note = {"version": VERSION, **Units(found.meters_per_unit).notes(), "from": start, "to": end, "meters": length}
    write_atomic(run / UNITS_FILE, to_json(note))
    return found
