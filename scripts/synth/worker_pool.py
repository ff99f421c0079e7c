"""Objects as jobs of a farm: each worker holds one Blender and renders one object after the other."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gsopt.farm.job import Job, Outcome
from gsopt.farm.serve import serve as answer_requests
from synth.mesh_items import Item
from synth.settings import Settings

SCRIPT = Path(__file__).resolve().parent.parent / "synth_views.py"
ADVICE = {
    "late": " Simplify it, or raise --time-limit.",
    "memory": " Simplify it, or raise --memory-limit.",
    "died": " Blender crashed on it; log.txt has its last words.",
}
ONE_FILE = {".glb", ".ply", ".stl", ".fbx", ".blend"}
"""Formats without files beside the mesh."""


def render_job(item: Item, settings: Settings, seed: int, out: Path, time_limit: float, memory: int | None) -> Job:
    """One object to render into the new folder `out`."""
    mesh, whole = item.mesh.absolute(), out.absolute()
    files = {name: Path(path).absolute() for name in ("camera_file", "hdri") if (path := getattr(settings, name))}
    named = replace(settings, **{name: str(path) for name, path in files.items()})
    request = {"item": asdict(item) | {"mesh": str(mesh)}, "settings": asdict(named), "seed": seed, "out": str(whole)}
    beside = mesh if mesh.suffix.lower() in ONE_FILE else mesh.parent
    inputs = (beside, SCRIPT.parent, *files.values())
    limits = {"cpus": max(1, settings.threads), "memory": memory, "seconds": time_limit}
    return Job(item.id, worker_command(), request, whole, inputs, **limits)


def reason(outcome: Outcome) -> str | None:
    """Reason for a missing object, with advice, or None."""
    return None if outcome.ending == "done" else outcome.error + ADVICE.get(outcome.ending, "")


def worker_command() -> tuple[str, ...]:
    """This interpreter with the bpy wheel; inside Blender, another Blender in the background."""
    bpy = sys.modules.get("bpy")
    if bpy is not None and bpy.app.binary_path:
        blender = (bpy.app.binary_path, "--background", "--factory-startup", "--python", str(SCRIPT))
        return (*blender, "--", "--worker")
    return (sys.executable, str(SCRIPT), "--worker")


def read_request(request: Mapping[str, Any]) -> tuple[Item, Settings, int, Path]:
    """The object of `render_job`; lists become tuples again."""

    def restore(fields: Mapping[str, Any]) -> dict[str, Any]:
        return {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()}

    item = Item(**restore(request["item"]) | {"mesh": Path(request["item"]["mesh"])})
    return item, Settings(**restore(request["settings"])), request["seed"], Path(request["out"])


def serve() -> None:
    """Be a worker: never returns."""
    from synth.render_object import render_object

    def handle(request: Mapping[str, Any]) -> dict[str, float]:
        item, settings, seed, out = read_request(request)
        return asdict(render_object(item.mesh, settings, seed, out, item))

    answer_requests(handle)
