"""3 Run, when it is done: share it as a page, clean its splats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from .core import arguments, job
from .core.errors import UsageError
from .operator_errors import ReportingOperator, WaitingOperator
from .operators_source import begin, refuse_two
from .preferences import absolute, python, work_folder

PAGE, PICTURE = "page.html", "clean.png"
SPLATS, BEFORE = "splat.ply", "splat.before-clean.ply"
METRICS_BEFORE = "metrics.before-clean.json"


def finished_run(context: Any) -> Path:
    """The attached run; UsageError when it has no result yet."""
    settings = context.scene.gsopt
    run = absolute(settings.run_path) if settings.run_path else None
    if run is None or not (run / SPLATS).is_file():
        raise UsageError("There is no finished run. Launch one, or attach to one.")
    return run


def work_on_run(
    context: Any, operator: WaitingOperator, product: str, kind: str, words: Callable[[Path, Path, Path], list[str]]
) -> str:
    """Start gsopt on the finished run; `words` makes the command of interpreter, run and the file to write."""
    refuse_two(context, kind)
    run = finished_run(context)
    folder = job.free_folder(work_folder(context) / "jobs", kind)
    call = words(python(context), run, run / product)
    return begin(context, operator, job.start(kind, call, folder, run / product))


class GSOPT_OT_share(WaitingOperator, bpy.types.Operator):
    """Write the run as one page that shows its splats in any browser, and open it"""

    bl_idname = "gsopt.share"
    bl_label = "Share Page"

    def do(self, context: Any) -> str:
        return work_on_run(context, self, PAGE, "page", arguments.page)


class GSOPT_OT_clean(WaitingOperator, bpy.types.Operator):
    """Leave out splats that no input view needs; Undo Clean brings them back"""

    bl_idname = "gsopt.clean"
    bl_label = "Clean"

    def do(self, context: Any) -> str:
        return work_on_run(context, self, PICTURE, "clean", lambda python, run, _: arguments.clean(python, run))


class GSOPT_OT_undo_clean(ReportingOperator, bpy.types.Operator):
    """Bring back the splats of before the run was cleaned"""

    bl_idname = "gsopt.undo_clean"
    bl_label = "Undo Clean"

    def do(self, context: Any) -> str:
        refuse_two(context, "clean")
        run = finished_run(context)
        before = run / BEFORE
        if before.is_symlink() or not before.is_file():
            raise UsageError(f"{run.name} was not cleaned. Nothing was changed.")
        before.replace(run / SPLATS)
        if (run / METRICS_BEFORE).is_file():
            (run / METRICS_BEFORE).replace(run / "metrics.json")
        return f"{run.name} is as it was. Import it to see it."


CLASSES = (GSOPT_OT_share, GSOPT_OT_clean, GSOPT_OT_undo_clean)
