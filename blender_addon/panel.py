"""The panel in the 3D view's sidebar: four sub-panels in the order of the work. Drawing reads, it never computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from . import loading, native, splat_object
from .panel_layout import Child, Rows, Sidebar, show_job, tell, values


class GSOPT_UL_prompts(Rows, bpy.types.UIList):
    """Text, weight, polarity and view of each prompt in a row."""

    def draw_row(self, layout: Any, item: Any) -> None:
        row = layout.row(align=True)
        row.prop(item, "text", text="", emboss=False, icon="ADD" if item.polarity == "positive" else "REMOVE")
        side = row.row(align=True)
        side.ui_units_x = 3
        side.label(text=f"{item.weight:g} {item.view}")


class GSOPT_UL_paths(Rows, bpy.types.UIList):
    """Files or folders by their last name."""

    def draw_row(self, layout: Any, item: Any) -> None:
        layout.label(text=Path(item.path).name, icon="FILE")


class GSOPT_PT_main(Sidebar, bpy.types.Panel):
    bl_idname = "GSOPT_PT_main"
    bl_label = "gsopt"

    def draw(self, context: Any) -> None:
        settings, layout = context.scene.gsopt, self.layout
        if settings.message:
            tell(layout.box(), settings.message, "ERROR")
        values(layout, settings, "folder")
        if not show_job(layout, settings.job_install, "install"):
            layout.operator("gsopt.install", icon="IMPORT")
        layout.operator("gsopt.allow_interpreter", icon="LOCKED")
        layout.operator("gsopt.test", text="Test Interpreter", icon="CHECKMARK")
        if settings.doctor:
            tell(layout.box(), settings.doctor, "INFO")


class GSOPT_PT_source(Child, bpy.types.Panel):
    bl_idname = "GSOPT_PT_source"
    bl_label = "1  Source"

    def draw(self, context: Any) -> None:
        settings, layout = context.scene.gsopt, self.layout
        layout.row().prop(settings, "source", expand=True)
        if settings.source == "MESH":
            values(layout, settings, "collection", "render_views", "render_test_views", "render_size")
            values(layout, settings, "render_samples", "render_layout")
            if not show_job(layout, settings.job_dataset, "dataset"):
                layout.operator("gsopt.render_dataset", icon="RENDER_STILL")
        elif settings.source == "PHOTOS":
            values(layout, settings, "photos")
            if not show_job(layout, settings.job_poses, "poses"):
                layout.operator("gsopt.find_poses", icon="CAMERA_DATA")
        else:
            values(layout, settings, "dataset")
            if not show_job(layout, settings.job_masks, "masks"):
                layout.operator("gsopt.cut_out", icon="MOD_MASK")


class GSOPT_PT_guidance(Child, bpy.types.Panel):
    bl_idname = "GSOPT_PT_guidance"
    bl_label = "2  Guidance"

    def draw(self, context: Any) -> None:
        settings, layout = context.scene.gsopt, self.layout
        values(layout, settings, "domain", *(["template"] if settings.domain == "own" else []), "notes")
        if not show_job(layout, settings.job_prompts, "prompts"):
            layout.operator("gsopt.propose", icon="OUTLINER_OB_FONT")
        if len(settings.proposals):
            draw_proposal(layout, settings)
        draw_prompts(layout, settings)
        draw_references(layout, settings)
        values(layout, settings, "prior")
        if settings.prior == "FOLDER":
            values(layout, settings, "prior_folder")
        if settings.prior not in ("off", "auto"):
            values(layout, settings, "lambda_sds")
        if settings.prior != "off":
            values(layout, settings, "front_view", "device")


def draw_proposal(layout: Any, settings: Any) -> None:
    """The first proposal, to be accepted, edited or rejected."""
    box, entry = layout.box(), settings.proposals[0]
    count = len(settings.proposals)
    box.label(text=f"{count} proposal{'s' * (count != 1)}, by {entry.source}")
    box.prop(entry, "text", text="")
    row = box.row(align=True)
    for name in ("weight", "view", "polarity"):
        row.prop(entry, name, text="")
    tell(box, f"{entry.rationale} {score_text(entry.score)}", most=4)
    row = box.row(align=True)
    row.operator("gsopt.proposal", text="Accept", icon="CHECKMARK").accept = True
    row.operator("gsopt.proposal", text="Reject", icon="X").accept = False
    every = row.operator("gsopt.proposal", text="Accept All")
    every.accept, every.all = True, True


def score_text(score: float) -> str:
    """Only where somebody measured it."""
    return f"Alignment with the views {score:.2f}" if score >= -1 else ""


def draw_prompts(layout: Any, settings: Any) -> None:
    row = layout.row()
    row.template_list("GSOPT_UL_prompts", "", settings, "prompts", settings, "prompt_index", rows=3)
    side = row.column(align=True)
    side.operator("gsopt.prompt_add", text="", icon="ADD")
    side.operator("gsopt.prompt_remove", text="", icon="REMOVE")
    side.separator()
    side.operator("gsopt.prompts_read", text="", icon="IMPORT")
    side.operator("gsopt.prompts_write", text="", icon="EXPORT")
    if 0 <= settings.prompt_index < len(settings.prompts):
        entry = settings.prompts[settings.prompt_index]
        column = layout.column(align=True)
        column.prop(entry, "text", text="")
        row = column.row(align=True)
        for name in ("weight", "view", "polarity"):
            row.prop(entry, name, text="")


def draw_references(layout: Any, settings: Any) -> None:
    layout.label(text="Reference images")
    row = layout.row()
    row.template_list(
        "GSOPT_UL_paths", "references", settings, "references", settings, "reference_index", rows=1, maxrows=4
    )
    side = row.column(align=True)
    side.operator("gsopt.reference_add", text="", icon="ADD")
    side.operator("gsopt.reference_remove", text="", icon="REMOVE")


class GSOPT_PT_run(Child, bpy.types.Panel):
    bl_idname = "GSOPT_PT_run"
    bl_label = "3  Run"

    def draw(self, context: Any) -> None:
        settings, layout = context.scene.gsopt, self.layout
        layout.row().prop(settings, "preset", expand=True)
        if settings.preset == "own":
            values(layout, settings, "iterations", "downscale", "strategy", "background", "hold_out")
        values(layout, settings, "budget", "views", "threads", "live")
        if settings.run_status in ("waiting", "running"):
            draw_progress(layout, settings)
            draw_colors(layout, context)
        else:
            layout.operator("gsopt.launch", icon="PLAY")
            draw_outcome(layout, settings)
        draw_runs(layout, settings)


def draw_progress(layout: Any, settings: Any) -> None:
    share = settings.run_step / settings.run_total if settings.run_total else 0.0
    said = f"{settings.run_step:,} of {settings.run_total:,}" if settings.run_total else "reading the data ..."
    layout.progress(factor=min(1.0, share), text=said)
    row = layout.row()
    row.label(text=f"PSNR {settings.run_psnr:.2f} dB" if settings.run_psnr >= 0 else "PSNR -")
    row.label(text=f"{clock(settings.run_eta)} left" if settings.run_eta >= 0 else "")
    layout.label(text=f"{settings.run_count:,} Gaussians")
    if settings.run_message:
        tell(layout.box(), settings.run_message, "INFO")
    row = layout.row(align=True)
    row.operator("gsopt.stop", icon="PAUSE").kill = False
    if settings.run_job:
        row.operator("gsopt.stop", text="End at Once", icon="CANCEL").kill = True
    row.operator("gsopt.log", text="", icon="TEXT")


def draw_outcome(layout: Any, settings: Any) -> None:
    if not settings.run_status:
        return
    box = layout.box()
    box.label(text=f"{Path(settings.run_path).name}: {settings.run_status}")
    if settings.run_step:
        box.label(text=f"step {settings.run_step:,}, {settings.run_count:,} Gaussians")
    tell(box, settings.run_message)
    row = box.row(align=True)
    row.operator("gsopt.import_splats", text="Import", icon="IMPORT").from_run = True
    if settings.run_status in ("stopped", "killed", "error"):
        row.operator("gsopt.resume", icon="PLAY")
    row.operator("gsopt.log", text="", icon="TEXT")
    if settings.run_status in ("done", "stopped"):
        draw_result(box, settings)


def draw_result(layout: Any, settings: Any) -> None:
    """Buttons for what comes after a run."""
    jobs = [(getattr(settings, f"job_{kind}"), kind) for kind in ("page", "clean", "mesh")]
    if not any([show_job(layout, entry, kind) for entry, kind in jobs]):
        row = layout.row(align=True)
        row.operator("gsopt.share", icon="URL")
        row.operator("gsopt.clean", icon="BRUSH_DATA")
        row.operator("gsopt.undo_clean", text="", icon="LOOP_BACK")
        layout.operator("gsopt.mesh_proxy", icon="MESH_ICOSPHERE")


def draw_runs(layout: Any, settings: Any) -> None:
    row = layout.row(align=True)
    row.label(text="Earlier runs")
    row.operator("gsopt.list_runs", text="", icon="FILE_REFRESH")
    row.operator("gsopt.attach", text="", icon="FILE_FOLDER")
    if not len(settings.runs):
        return
    layout.template_list("GSOPT_UL_paths", "runs", settings, "runs", settings, "runs_index", rows=2)
    if 0 <= settings.runs_index < len(settings.runs):
        row = layout.row(align=True)
        path = settings.runs[settings.runs_index].path
        row.operator("gsopt.attach", text="Attach").directory = path
        row.operator("gsopt.import_splats", text="Import").filepath = path


def clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"


class GSOPT_PT_inspect(Child, bpy.types.Panel):
    bl_idname = "GSOPT_PT_inspect"
    bl_label = "4  Inspect"

    def draw(self, context: Any) -> None:
        settings, layout = context.scene.gsopt, self.layout
        values(layout, settings, "display", "most_shown", "up")
        if not show_job(layout, settings.job_import, "import"):
            row = layout.row(align=True)
            row.operator("gsopt.import_splats", icon="IMPORT")
            row.operator("gsopt.import_sequence", text="", icon="SEQUENCE")
        row = layout.row(align=True)
        row.operator("gsopt.import_cameras", text="Cameras", icon="OUTLINER_OB_CAMERA")
        row.operator("gsopt.look_through", text="", icon="TRIA_LEFT").step = -1
        row.operator("gsopt.look_through", text="", icon="TRIA_RIGHT").step = 1
        layout.prop(settings, "picture", text="Input Picture", slider=True)
        row = layout.row(align=True)
        row.label(text="Camera path")
        row.operator("gsopt.import_camera_path", text="", icon="IMPORT")
        row.operator("gsopt.export_camera_path", text="", icon="EXPORT")
        active = context.view_layer.objects.active
        if splat_object.is_splats(active):
            draw_display(layout, active)
            draw_colors(layout, context)
            draw_summary(layout, active)
            draw_filters(layout, settings)
            draw_scale(layout, settings)


def draw_display(layout: Any, thing: Any) -> None:
    box = layout.box()
    box.label(text=thing.name, icon="POINTCLOUD_DATA")
    values(
        box, thing.gsopt, "display", "size", "extent", "least_opacity", "most_shown", "color_by_view", "linear_color"
    )
    if native.kind_here():
        box.operator("gsopt.native_splats", icon="POINTCLOUD_DATA")


def draw_colors(layout: Any, context: Any) -> None:
    """Draws what decides whether splats show their own colors: Solid view is gray, AgX paler than the photos."""
    shading, view = context.space_data.shading, context.scene.view_settings
    if shading.type in ("SOLID", "WIREFRAME"):
        row = layout.row()
        row.label(text="Colors show in")
        row.prop_enum(shading, "type", "MATERIAL", text="Material Preview")
    elif view.view_transform not in ("Standard", "Raw"):
        row = layout.row()
        row.label(text="Colors as learned")
        row.prop_enum(view, "view_transform", "Standard")


def draw_summary(layout: Any, thing: Any) -> None:
    box = layout.box()
    box.operator("gsopt.statistics", icon="FILE_REFRESH")
    found = loading.SUMMARIES.get(thing.data.name)
    if found is None or not found.count:
        return
    box.label(text=f"{found.count:,} splats, {found.outliers:,} outliers")
    if found.left_out:
        box.label(text=f"{found.left_out:,} left out: not finite, or no rotation", icon="ERROR")
    row = box.row()
    for title, bars in (("Opacity from", found.opacities), ("Size from", found.sizes)):
        column = row.column(align=True)
        column.scale_y = 0.75
        column.label(text=title)
        most = max(bar.count for bar in bars)
        for bar in bars:
            column.progress(factor=bar.count / most, text=f"{bar.low:.2g}:  {bar.count:,}")


def draw_filters(layout: Any, settings: Any) -> None:
    box = layout.box()
    values(box, settings, "least_opacity", "largest_scale", "farthest", *(["center"] if settings.farthest else []))
    values(box, settings, "box", "no_outliers")
    row = box.row(align=True)
    row.operator("gsopt.filter", text="Hide")
    row.operator("gsopt.show_all")
    row.operator("gsopt.delete_hidden", text="Delete")
    box.operator("gsopt.export", icon="EXPORT")


def draw_scale(layout: Any, settings: Any) -> None:
    """True size from two splats that are selected in Edit Mode."""
    if not show_job(layout, settings.job_measure, "measure"):
        row = layout.row(align=True)
        row.prop(settings, "known_length")
        row.operator("gsopt.set_scale", text="", icon="DRIVER_DISTANCE")


CLASSES = (
    GSOPT_UL_prompts,
    GSOPT_UL_paths,
    GSOPT_PT_main,
    GSOPT_PT_source,
    GSOPT_PT_guidance,
    GSOPT_PT_run,
    GSOPT_PT_inspect,
)
