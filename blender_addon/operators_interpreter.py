"""Consent: a Python that was merely found runs only after the user has allowed it, once per interpreter."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from .core import arguments, interpreter, job
from .core.errors import UsageError
from .operator_errors import ReportingOperator, WaitingOperator
from .operators_source import begin, refuse_two
from .preferences import DEFAULTS, allowed, preferences, project_folder, work_folder


class GSOPT_OT_allow_interpreter(ReportingOperator, bpy.types.Operator):
    """Allow the Python that was found beside the open file or on PATH to run; the preferences remember it"""

    bl_idname = "gsopt.allow_interpreter"
    bl_label = "Allow Interpreter"

    path: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        found = [str(path) for path in interpreter.candidates(project_folder(), os.environ)]
        self.path = next((path for path in found if path not in allowed(context)), "")
        if not self.path:
            return self.execute(context)
        answer: set[str] = context.window_manager.invoke_confirm(
            self,
            event,
            title="Run this Python?",
            message=f"{self.path} can do whatever you can. Allow it only if you trust whoever made it.",
            confirm_text="Allow",
            icon="WARNING",
        )
        return answer

    def do(self, context: Any) -> str:
        machine = preferences(context)
        if machine is DEFAULTS:
            raise UsageError("The extension is not enabled and cannot remember the answer. Enable it first.")
        if not self.path:
            raise UsageError("No other Python with gsopt is beside the open file or on PATH. Set the interpreter.")
        path = str(interpreter.usable(self.path))
        if path not in allowed(context):
            machine.allowed.add().path = path
            context.preferences.is_dirty = True
        return f"{path} may run"


class GSOPT_OT_install(WaitingOperator, bpy.types.Operator):
    """Install gsopt into a Python environment of its own, without a compiler: some gigabytes from the package index"""

    bl_idname = "gsopt.install"
    bl_label = "Install gsopt"

    def invoke(self, context: Any, event: Any) -> set[str]:
        answer: set[str] = context.window_manager.invoke_confirm(
            self,
            event,
            title="Install gsopt?",
            message=f"{preferences(context).package} and what it needs (some gigabytes) go to {environment_folder()}.",
            confirm_text="Install",
            icon="IMPORT",
        )
        return answer

    def do(self, context: Any) -> str:
        refuse_two(context, "install")
        package = preferences(context).package.strip()
        if not package:
            raise UsageError("No package is named. Set it in the preferences: gsopt, or the path of a wheel.")
        if not os.path.isfile(package) and not bpy.app.online_access:
            raise UsageError("Blender may not go online. Allow it in the preferences, or name a wheel's path.")
        venv = environment_folder()
        folder = job.free_folder(work_folder(context) / "jobs", "install")
        work = job.start("install", arguments.install(venv, package), folder, interpreter.python_of(venv))
        return begin(context, self, work)


def environment_folder() -> Path:
    """The extension's own environment: it outlasts upgrades, and goes with the extension."""
    if str(__package__).startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(__package__, path="python"))
    return Path(bpy.utils.user_resource("CONFIG")) / "gsopt-python"


class GSOPT_OT_forget_interpreters(ReportingOperator, bpy.types.Operator):
    """Ask again before a Python runs that was merely found"""

    bl_idname = "gsopt.forget_interpreters"
    bl_label = "Forget Allowed"

    def do(self, context: Any) -> None:
        if allowed(context):
            preferences(context).allowed.clear()
            context.preferences.is_dirty = True


CLASSES = (GSOPT_OT_allow_interpreter, GSOPT_OT_install, GSOPT_OT_forget_interpreters)
