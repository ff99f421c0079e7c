"""Everything that Blender must know about, and must forget again."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from . import (
    mesh_proxy,
    native,
    operators_camera_path,
    operators_cameras,
    operators_guidance,
    operators_inspect,
    operators_interpreter,
    operators_result,
    operators_run,
    operators_scale,
    operators_source,
    panel,
    preferences,
    progress_timer,
    properties,
    sequence,
)

CLASSES = (
    *properties.CLASSES,
    preferences.GsoptPreferences,
    *operators_interpreter.CLASSES,
    *operators_source.CLASSES,
    *operators_guidance.CLASSES,
    *operators_run.CLASSES,
    *operators_result.CLASSES,
    *mesh_proxy.CLASSES,
    *operators_scale.CLASSES,
    *operators_cameras.CLASSES,
    *operators_camera_path.CLASSES,
    *operators_inspect.CLASSES,
    *native.CLASSES,
    *sequence.CLASSES,
    *panel.CLASSES,
)


@persistent
def after_load(*_: Any) -> None:
    """A file was opened: whatever it left running is followed again."""
    progress_timer.pick_up()


@persistent
def before_undo(*_: Any) -> None:
    progress_timer.before_undo()


@persistent
def after_undo(*_: Any) -> None:
    progress_timer.after_undo()


HANDLERS = {
    "load_post": after_load,
    "undo_pre": before_undo,
    "undo_post": after_undo,
    "redo_pre": before_undo,
    "redo_post": after_undo,
}


def menu(self: Any, context: Any) -> None:
    self.layout.operator("gsopt.import_splats", text="Gaussian Splats (.ply, .spz)")


def export_menu(self: Any, context: Any) -> None:
    self.layout.operator("gsopt.export", text="Gaussian Splats (.ply)")


def register() -> None:
    for kind in CLASSES:
        bpy.utils.register_class(kind)
    bpy.types.Scene.gsopt = bpy.props.PointerProperty(type=properties.GsoptScene)
    bpy.types.Object.gsopt = bpy.props.PointerProperty(type=properties.GsoptObject)
    bpy.types.TOPBAR_MT_file_import.append(menu)
    bpy.types.TOPBAR_MT_file_export.append(export_menu)
    for moment, handler in HANDLERS.items():
        getattr(bpy.app.handlers, moment).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(after_load, first_interval=0.1)  # the file that is open when it is enabled


def unregister() -> None:
    if bpy.app.timers.is_registered(after_load):
        bpy.app.timers.unregister(after_load)
    progress_timer.forget()
    for moment, handler in HANDLERS.items():
        if handler in getattr(bpy.app.handlers, moment):
            getattr(bpy.app.handlers, moment).remove(handler)
    bpy.types.TOPBAR_MT_file_export.remove(export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    del bpy.types.Object.gsopt
    del bpy.types.Scene.gsopt
    for kind in reversed(CLASSES):
        bpy.utils.unregister_class(kind)
