"""1 Source: a mesh becomes a dataset, photos get their poses."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import bpy

from . import progress_timer
from .core import arguments, job
from .core.errors import InputError, UsageError
from .operator_errors import ReportingOperator, WaitingOperator
from .preferences import absolute, python, script, work_folder


def begin(context: Any, operator: WaitingOperator, work: job.Job) -> str:
    """Follow a program that was started, without a window until its end."""
    progress_timer.started(context.scene, work)
    entry = getattr(context.scene.gsopt, f"job_{work.kind}")
    operator.settle(lambda: entry.state == "RUNNING", lambda: entry.message if entry.state == "FAILED" else "")
    return "Done." if operator.waits else "Started. The panel shows how far it is."


def refuse_two(context: Any, kind: str) -> None:
    if getattr(context.scene.gsopt, f"job_{kind}").state == "RUNNING":
        raise UsageError("This work is going on already. Wait for it, or cancel it first.")


class GSOPT_OT_test(WaitingOperator, bpy.types.Operator):
    """Ask the interpreter what it has: `gsopt doctor`"""

    bl_idname = "gsopt.test"
    bl_label = "Test"

    def do(self, context: Any) -> str:
        refuse_two(context, "doctor")
        context.scene.gsopt.doctor = "asking ..."
        folder = job.free_folder(work_folder(context) / "jobs", "doctor")
        begin(context, self, job.start("doctor", arguments.doctor(python(context)), folder))
        return str(context.scene.gsopt.doctor)


class GSOPT_OT_render_dataset(WaitingOperator, bpy.types.Operator):
    """Render posed views of the selected objects, or of the collection, in a Blender of its own"""

    bl_idname = "gsopt.render_dataset"
    bl_label = "Render Dataset"

    def do(self, context: Any) -> str:
        refuse_two(context, "dataset")
        settings, shapes = context.scene.gsopt, chosen_objects(context)
        rendering = arguments.Rendering(
            views=settings.render_views,
            test_views=settings.render_test_views,
            resolution=settings.render_size,
            layout=settings.render_layout,
            samples=settings.render_samples,
            seed=settings.seed,
            threads=settings.threads,
        )
        out = job.free_folder(work_folder(context) / "datasets", safe(settings.collection or shapes[0]))
        folder = job.free_folder(work_folder(context) / "jobs", "dataset")
        renderer, mesh = script(context), write_shapes(folder, shapes)
        call = arguments.render(bpy.app.binary_path, sys.executable, renderer, mesh, out, rendering)
        return begin(context, self, job.start("dataset", call, folder, out, rendering.total))


def safe(thing: Any) -> str:
    """A name as a folder: letters of every script stay."""
    kept = "".join(c if c.isalnum() or c in "-_ " else "_" for c in thing.name).strip()
    return kept[:60] or "object"


def chosen_objects(context: Any) -> list[Any]:
    """Returns the meshes to render. UsageError when there is nothing with a surface."""
    collection = context.scene.gsopt.collection
    among = collection.all_objects if collection else context.selected_objects
    solids = ("MESH", "CURVE", "SURFACE", "FONT", "META")
    found = [o for o in among if o.type in solids and not o.hide_render and not o.data.get("gsopt_splats")]
    if not found:
        raise UsageError("Nothing to render is selected. Select a mesh, or choose a collection.")
    return found


def write_shapes(folder: Path, shapes: list[Any]) -> Path:
    """The objects with all that they use in a .blend of their own: modifiers and materials stay what they are."""
    path = folder / "shapes.blend"
    stage = bpy.data.scenes.new("gsopt stage")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for shape in shapes:
            stage.collection.objects.link(shape)
        # Blender 5.2 crashes on writing a scene whose layers were never brought up to date.
        stage.view_layers[0].update()
        bpy.data.libraries.write(str(path), {stage}, path_remap="ABSOLUTE", compress=False)
    except (OSError, RuntimeError) as error:
        raise InputError(f"Cannot write {path}: {error}. Free some space or choose another work folder.") from error
    finally:
        bpy.data.scenes.remove(stage)
    return path


class GSOPT_OT_find_poses(WaitingOperator, bpy.types.Operator):
    """Find where the photos were taken from: `gsopt sfm`"""

    bl_idname = "gsopt.find_poses"
    bl_label = "Find Poses"

    def do(self, context: Any) -> str:
        refuse_two(context, "poses")
        settings = context.scene.gsopt
        if not settings.photos:
            raise UsageError("No photos are chosen. Choose a folder of photos or a video.")
        photos = absolute(settings.photos)
        if not photos.exists():
            raise InputError(f"There is nothing at {photos}. Choose a folder of photos or a video.")
        out = job.free_folder(work_folder(context) / "datasets", f"{photos.stem or 'photos'}-posed")
        out.parent.mkdir(parents=True, exist_ok=True)
        call = arguments.poses(python(context), photos, out, settings.seed, settings.threads)
        folder = job.free_folder(work_folder(context) / "jobs", "poses")
        return begin(context, self, job.start("poses", call, folder, out))


class GSOPT_OT_cut_out(WaitingOperator, bpy.types.Operator):
    """Cut the object out of the dataset's photos: `gsopt masks`"""

    bl_idname = "gsopt.cut_out"
    bl_label = "Cut Out Object"

    def do(self, context: Any) -> str:
        refuse_two(context, "masks")
        settings = context.scene.gsopt
        if not settings.dataset:
            raise UsageError("No dataset is chosen. Choose one, or find the poses of photos.")
        data = absolute(settings.dataset)
        if (data / "masks").exists():
            raise UsageError(f"{data} has masks already. Remove its folder masks to make them again.")
        call = arguments.masks(python(context), data)
        folder = job.free_folder(work_folder(context) / "jobs", "masks")
        return begin(context, self, job.start("masks", call, folder, data / "masks"))


class GSOPT_OT_cancel(ReportingOperator, bpy.types.Operator):
    """End this work"""

    bl_idname = "gsopt.cancel"
    bl_label = "Cancel"

    kind: bpy.props.StringProperty()  # type: ignore[valid-type]

    def do(self, context: Any) -> str:
        if self.kind not in progress_timer.KINDS:
            raise UsageError(
                f"There is no work called {self.kind!r:.40}. Name one of {', '.join(progress_timer.KINDS)}."
            )
        entry = getattr(context.scene.gsopt, f"job_{self.kind}")
        job.end(job.read_job(Path(entry.folder)))
        entry.state, entry.message = "NONE", "Canceled."
        return "Canceled."


CLASSES = (GSOPT_OT_test, GSOPT_OT_render_dataset, GSOPT_OT_find_poses, GSOPT_OT_cut_out, GSOPT_OT_cancel)
