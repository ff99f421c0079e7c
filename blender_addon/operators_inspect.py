"""4 Inspect: bring splats and cameras in, look at them, filter, delete, export."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from . import loading, progress_timer, splat_object
from .core import dataset, statistics
from .core.errors import InputError, UsageError
from .core.files import read_json
from .core.placement import placed
from .core.ply import write_ply
from .core.units import meters_per_unit
from .material import let_cycles_see_through
from .operator_errors import ReportingOperator, WaitingOperator
from .preferences import absolute

METERS = "gsopt_meters"
"""Custom property: the scale that an object has."""
UPRIGHT = Matrix.Rotation(-math.pi / 2, 4, "X")


def active_splats(context: Any) -> Any:
    """The active object, or the only splats there are. UsageError where that is unclear."""
    active = context.view_layer.objects.active
    found = [o for o in context.scene.objects if splat_object.is_splats(o) and not o.get(progress_timer.LIVE)]
    if splat_object.is_splats(active):
        found = [active]
    if len(found) != 1:
        raise UsageError(f"{len(found)} objects hold splats. Select the one that is meant, or import one.")
    if found[0].mode == "EDIT":
        raise UsageError("The splats are being edited. Leave Edit Mode (Tab) first.")
    return found[0]


def data_of(run: Path) -> Path | None:
    """The dataset that a run learned from."""
    try:
        return Path(read_json(run / "config.json")["config"]["data"]["path"])
    except (InputError, KeyError, TypeError):
        return None


def frame(settings: Any, data: Path | None, scale: float = 1.0) -> Matrix:
    """From the splats' axes to the scene's; `scale`: meters of one of their units."""
    meters = Matrix.Scale(scale, 4)
    if settings.up == "MINUS_Y":
        return meters @ UPRIGHT
    if settings.up == "DATASET" and data is not None:
        found = dataset.scene_from_dataset(data)
        if found is not None:
            return meters @ Matrix(found.tolist())
    return meters


class GSOPT_OT_import_splats(WaitingOperator, bpy.types.Operator):
    """Import splats: a run, a .ply or an .spz"""

    bl_idname = "gsopt.import_splats"
    bl_label = "Import Splats"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.ply;*.spz", options={"HIDDEN"})  # type: ignore[valid-type]
    from_run: bpy.props.BoolProperty(name="From the Run", default=False, options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        if self.from_run:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        scene, settings = context.scene, context.scene.gsopt
        if settings.job_import.state == "RUNNING":
            raise UsageError("A file is being imported. Wait for it.")
        chosen = settings.run_path if self.from_run else self.filepath
        if not chosen:
            raise UsageError("No splats are named. Choose a file, or attach to a run first.")
        source, replaces_live = absolute(chosen), self.from_run
        path = loading.splat_file(source)
        scale = meters_per_unit(source)
        matrix = frame(settings, data_of(source if source.is_dir() else path.parent), scale)

        def finish(target: Any, mesh: Any, summary: statistics.Summary) -> Iterator[None]:
            thing = progress_timer.add_object(target, mesh, summary, str(source), target.gsopt.display)
            thing.matrix_world, thing[METERS] = matrix, scale
            live = progress_timer.live_object(target) if replaces_live else None
            if live is not None:
                splat_object.remove(bpy, live)
            let_cycles_see_through(target)
            yield  # Blender evaluates the nodes
            activate(thing)
            yield
            progress_timer.undo_step("Import Splats")

        progress_timer.load(scene, [path], finish)
        state = settings.job_import
        self.settle(lambda: state.state == "RUNNING", lambda: settings.message if state.state == "FAILED" else "")
        return f"{path.name} imported" if self.waits else f"Reading {path.name}"


def activate(thing: Any) -> None:
    """Make it the active object, not a selected one: the outlines of thousands of splats would hide their colors."""
    layer = bpy.context.view_layer
    layer.update()
    if thing.name in layer.objects:
        for other in list(layer.objects.selected):
            other.select_set(False)
        layer.objects.active = thing


class GSOPT_OT_statistics(ReportingOperator, bpy.types.Operator):
    """Count the splats and draw their histograms"""

    bl_idname = "gsopt.statistics"
    bl_label = "Statistics"

    def do(self, context: Any) -> str:
        mesh = active_splats(context).data
        shown = splat_object.read_mesh(mesh, harmonics=False).rows(~splat_object.hidden(mesh))
        found = loading.SUMMARIES[mesh.name] = statistics.summary(shown)
        return f"{found.count:,} splats, {found.outliers:,} outliers"


class GSOPT_OT_filter(ReportingOperator, bpy.types.Operator):
    """Hide the splats that do not pass; nothing is deleted"""

    bl_idname = "gsopt.filter"
    bl_label = "Hide What Fails"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> str:
        thing = active_splats(context)
        kept = chosen_filter(context.scene.gsopt, thing).keeps(splat_object.MeshShapes(thing.data))
        splat_object.hide(thing.data, ~kept)
        loading.SUMMARIES.pop(thing.data.name, None)
        return f"{int(kept.sum()):,} of {len(kept):,} splats pass"


def chosen_filter(settings: Any, thing: Any) -> statistics.Filter:
    """Returns the panel's filters in the splats' own frame."""
    inverse = thing.matrix_world.inverted_safe()
    scale = inverse.to_scale().x
    box = None
    if settings.box is not None:
        corners = np.array([tuple(corner) for corner in settings.box.bound_box])
        low, high = corners.min(axis=0), corners.max(axis=0)
        unit = Matrix.Translation(0.5 * (low + high)) @ Matrix.Diagonal((*np.maximum(0.5 * (high - low), 1e-9), 1.0))
        box = np.array((settings.box.matrix_world @ unit).inverted_safe() @ thing.matrix_world)
    return statistics.Filter(
        opacity=(settings.least_opacity, 1.0),
        largest_scale=settings.largest_scale * scale or None,
        farthest=settings.farthest * scale or None,
        center=tuple(inverse @ settings.center.copy()) if settings.farthest else (0.0, 0.0, 0.0),
        box_from_local=box,
        without_outliers=settings.no_outliers,
    )


class GSOPT_OT_show_all(ReportingOperator, bpy.types.Operator):
    """Show the hidden splats again"""

    bl_idname = "gsopt.show_all"
    bl_label = "Show All"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> None:
        mesh = active_splats(context).data
        splat_object.hide(mesh, np.zeros(len(mesh.vertices), bool))
        loading.SUMMARIES.pop(mesh.name, None)


class GSOPT_OT_delete_hidden(ReportingOperator, bpy.types.Operator):
    """Delete the hidden splats from the object; the file stays as it is"""

    bl_idname = "gsopt.delete_hidden"
    bl_label = "Delete Hidden"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> str:
        thing = active_splats(context)
        gone = splat_object.hidden(thing.data)
        if not gone.any():
            raise UsageError("No splat is hidden. Set a filter and hide what fails first.")
        kept = splat_object.read_mesh(thing.data).rows(~gone)
        splat_object.replace_mesh(bpy, thing, splat_object.make_mesh(bpy, thing.data.name, kept))
        loading.SUMMARIES[thing.data.name] = statistics.summary(kept)
        return f"{int(gone.sum()):,} splats deleted, {len(kept):,} left"


class GSOPT_OT_export(ReportingOperator, bpy.types.Operator):
    """Write the splats that are not hidden to a PLY, in the axes of the file they came from, or as they are placed"""

    bl_idname = "gsopt.export"
    bl_label = "Export PLY"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})  # type: ignore[valid-type]
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]
    as_placed: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Blender's Axes",
        description="Turn, move and scale them as the object is, colors too. Blender 5.3's own import turns nothing",
        default=False,
    )

    def invoke(self, context: Any, event: Any) -> set[str]:
        self.filepath = self.filepath or "splats.ply"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        thing = active_splats(context)
        splats = splat_object.read_mesh(thing.data).rows(~splat_object.hidden(thing.data))
        if self.as_placed:
            splats = placed(splats, thing.matrix_world)
        path = absolute(self.filepath)
        if path.suffix.lower() != ".ply":
            path = path.with_name(f"{path.name}.ply")
            refuse_to_replace(path)
        write_ply(path, splats, comment="Generated by gsopt for Blender")
        return f"{len(splats):,} splats in {path}"


def refuse_to_replace(path: Path) -> None:
    """The file dialog asks about the name it was given, not about the one that its suffix makes of it."""
    if path.exists():
        raise UsageError(f"{path} exists already. Choose another name, or this one with its .ply to replace it.")


CLASSES = (
    GSOPT_OT_import_splats,
    GSOPT_OT_statistics,
    GSOPT_OT_filter,
    GSOPT_OT_show_all,
    GSOPT_OT_delete_hidden,
    GSOPT_OT_export,
)
