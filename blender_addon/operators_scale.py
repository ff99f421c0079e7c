"""4 Inspect: the true size of a run, from the known length between two of its splats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

from . import mesh_proxy, splat_object
from .core import arguments, job
from .core.errors import InputError, UsageError
from .core.units import FILE, meters_per_unit
from .job_results import FINISH
from .operator_errors import WaitingOperator
from .operators_inspect import METERS
from .operators_source import begin, refuse_two
from .preferences import absolute, python, work_folder


def chosen_splats(context: Any) -> tuple[Any, Any, Any]:
    """The active splats and two selected vertices of them, in the frame of the file. UsageError for anything else."""
    thing = context.view_layer.objects.active
    if not splat_object.is_splats(thing):
        raise UsageError("No splats are active. Select the imported splats, and two of them in Edit Mode.")
    if thing.mode == "EDIT":
        thing.update_from_editmode()
    found = [vertex.co.copy() for vertex in thing.data.vertices if vertex.select]
    if len(found) != 2:
        raise UsageError(f"{len(found)} splats are selected. Select the two ends of the known length in Edit Mode.")
    return thing, found[0], found[1]


class GSOPT_OT_set_scale(WaitingOperator, bpy.types.Operator):
    """Give the run its true size: the known length lies between the two splats selected in Edit Mode"""

    bl_idname = "gsopt.set_scale"
    bl_label = "Set Scale"

    def do(self, context: Any) -> str:
        refuse_two(context, "measure")
        thing, start, end = chosen_splats(context)
        run = absolute(thing.gsopt.run)
        if not (run / "config.json").is_file():
            raise UsageError("These splats belong to no run. Import them from a run, which keeps the scale.")
        call = arguments.measure(python(context), run, start, end, context.scene.gsopt.known_length)
        folder = job.free_folder(work_folder(context) / "jobs", "measure")
        return begin(context, self, job.start("measure", call, folder, run / FILE))


def finish_measure(scene: Any, work: job.Job) -> None:
    """Scale everything of the run about the origin, from the scale it has to the one that was measured."""
    note = Path(work.product)
    if not note.is_file() or note.stat().st_mtime < work.started - 1:
        raise InputError(job.complaint(work))
    run, scale = note.parent, meters_per_unit(note.parent)
    for thing in scene.objects:
        came_from = absolute(thing.gsopt.run) if thing.gsopt.run else None
        if came_from == run or thing.get(mesh_proxy.PROXY) == str(run):
            thing.matrix_world = Matrix.Scale(scale / thing.get(METERS, 1.0), 4) @ thing.matrix_world
            thing[METERS] = scale


FINISH["measure"] = finish_measure  # here, because the timer imports the others
CLASSES = (GSOPT_OT_set_scale,)
