"""Preferences of the machine, not of the scene: interpreter, work folder, the language model's address."""

from __future__ import annotations

import os
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
from bpy.props import CollectionProperty, StringProperty

from .core import interpreter
from .properties import GsoptPath

DEFAULTS = SimpleNamespace(interpreter="", package="gsopt[sfm]", checkout="", folder="", llm="", model="", allowed=())


class GsoptPreferences(bpy.types.AddonPreferences):
    """Set once."""

    bl_idname = __package__

    interpreter: StringProperty(  # type: ignore[valid-type]
        name="Interpreter",
        description="Python in which gsopt is installed; empty: one that you allow, beside the file or on PATH",
        subtype="FILE_PATH",
    )
    allowed: CollectionProperty(type=GsoptPath)  # type: ignore[valid-type]
    """Interpreters that were found and that the user has allowed to run, by their real paths."""
    package: StringProperty(  # type: ignore[valid-type]
        name="Package",
        description="What Install gsopt installs: a name on the package index, or the path of a wheel",
        default=DEFAULTS.package,
    )
    checkout: StringProperty(  # type: ignore[valid-type]
        name="Source Folder",
        description="Folder of gsopt's sources with scripts/synth_views.py; empty: found above the interpreter",
        subtype="DIR_PATH",
    )
    folder: StringProperty(  # type: ignore[valid-type]
        name="Work Folder",
        description="Where datasets, runs and logs go; empty: `gsopt` beside the saved file, else in the home folder",
        subtype="DIR_PATH",
    )
    llm: StringProperty(  # type: ignore[valid-type]
        name="Language Model",
        description="Address of an OpenAI-compatible server that writes prompts; empty: templates write them",
    )
    model: StringProperty(name="Model", description="Its name on that server")  # type: ignore[valid-type]

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        for name in ("interpreter", "package", "checkout", "folder", "llm", "model"):
            layout.prop(self, name)
        for entry in self.allowed:
            layout.label(text=f"Allowed: {entry.path}", icon="CHECKMARK")
        row = layout.row(align=True)
        row.operator("gsopt.test", icon="CHECKMARK")
        row.operator("gsopt.install", icon="IMPORT")
        row.operator("gsopt.allow_interpreter", icon="LOCKED")
        row.operator("gsopt.forget_interpreters", icon="X")
        for line in textwrap.wrap(context.scene.gsopt.doctor, 90):
            layout.label(text=line)


def preferences(context: Any) -> Any:
    """The preferences, or their defaults where the extension runs without being enabled."""
    entry = context.preferences.addons.get(__package__)
    return DEFAULTS if entry is None or entry.preferences is None else entry.preferences


def absolute(path: str) -> Path:
    """A path as the interface has it, `//` being the folder of the file."""
    return Path(os.path.abspath(bpy.path.abspath(path)))


def work_folder(context: Any) -> Path:
    """Returns the folder of datasets, runs and logs."""
    chosen = context.scene.gsopt.folder or preferences(context).folder
    if chosen:
        return absolute(chosen)
    return absolute("//gsopt") if bpy.data.filepath else Path.home() / "gsopt"


def project_folder() -> Path | None:
    """The folder of the open file."""
    return Path(bpy.data.filepath).parent if bpy.data.filepath else None


def allowed(context: Any) -> set[str]:
    """Interpreters that were found and may run."""
    return {entry.path for entry in preferences(context).allowed}


def python(context: Any) -> Path:
    """The interpreter with gsopt. UsageError, with what to do, where there is none that may run."""
    return interpreter.find(preferences(context).interpreter, allowed(context), project_folder(), os.environ)


def script(context: Any) -> Path:
    """scripts/synth_views.py of the sources."""
    return interpreter.checkout(python(context), preferences(context).checkout) / interpreter.SCRIPT
