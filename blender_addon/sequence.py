"""A sequence of splats: how a run learned, or runs one after the other, each shown for some frames of the animation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy

from . import progress_timer
from .core import run_follower, statistics
from .core.errors import UsageError
from .core.units import meters_per_unit
from .material import let_cycles_see_through
from .operator_errors import WaitingOperator
from .operators_inspect import METERS, activate, data_of, frame
from .preferences import absolute

SEQUENCE = "gsopt_sequence"
"""Custom property of the empty that moves a whole sequence: its folder."""


class GSOPT_OT_import_sequence(WaitingOperator, bpy.types.Operator):
    """Import the previews of a run, or all runs of a folder, as an animation: each is shown for some frames"""

    bl_idname = "gsopt.import_sequence"
    bl_label = "Import Sequence"

    directory: bpy.props.StringProperty(subtype="DIR_PATH")  # type: ignore[valid-type]
    frames: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Frames Each", description="Frames for which each is shown", default=6, min=1, max=10_000
    )
    most: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Most Splats of Each", description="Every k-th of more; 0: all", default=200_000, min=0
    )

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        scene, settings = context.scene, context.scene.gsopt
        if settings.job_import.state == "RUNNING":
            raise UsageError("A file is being imported. Wait for it.")
        if not self.directory:
            raise UsageError("No folder is named. Choose a run, or a folder of runs.")
        folder = absolute(self.directory)
        paths = run_follower.sequence_of(folder)
        home = bpy.data.objects.new(f"{folder.name} sequence", None)
        home[SEQUENCE] = str(folder)
        scene.collection.objects.link(home)
        shown, first, frames = iter(paths), scene.frame_current, self.frames

        def finish(target: Any, mesh: Any, summary: statistics.Summary) -> Iterator[None]:
            path = next(shown)
            thing = progress_timer.add_object(target, mesh, summary, str(path), target.gsopt.display)
            place(thing, path, target.gsopt, home)
            key(thing, first, frames, paths.index(path), len(paths))
            if path == paths[-1]:
                target.frame_end = max(target.frame_end, first + frames * len(paths) - 1)
                let_cycles_see_through(target)
                activate(home)
                yield
                progress_timer.undo_step("Import Sequence")
            yield

        progress_timer.load(scene, paths, finish, self.most)
        state = settings.job_import
        self.settle(lambda: state.state == "RUNNING", lambda: settings.message if state.state == "FAILED" else "")
        return f"{len(paths)} sets of splats, {frames} frames each" if self.waits else f"Reading {folder.name}"


def place(thing: Any, path: Path, settings: Any, home: Any) -> None:
    """Put splats where their run lies, and give them to the empty that moves all."""
    run = path.parent.parent if path.parent.name == "previews" else path.parent
    thing[METERS] = meters_per_unit(run)
    thing.parent = home
    thing.matrix_basis = frame(settings, data_of(run), thing[METERS])


def key(thing: Any, first: int, frames: int, number: int, count: int) -> None:
    """Show an object during its own frames only; the first also before, the last also after."""
    start = first + frames * number
    hidden = {start - 1: True} if number else {}
    hidden |= {start: False} | ({start + frames: True} if number < count - 1 else {})
    for name in ("hide_viewport", "hide_render"):
        for at, value in hidden.items():
            setattr(thing, name, value)
            thing.keyframe_insert(name, frame=at)


CLASSES = (GSOPT_OT_import_sequence,)
