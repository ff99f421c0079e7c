"""3 Run: launch, follow, stop, find again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from . import progress_timer
from .core import arguments, job, run_follower
from .core.errors import InputError, UsageError
from .operator_errors import LONG, ReportingOperator, WaitingOperator
from .operators_guidance import guidance
from .operators_source import safe
from .preferences import absolute, python, work_folder


def going_on(scene: Any) -> bool:
    return scene.gsopt.run_status in progress_timer.OPEN


def follow(context: Any, operator: WaitingOperator, said: str) -> str:
    """Without a window: to the end of the run."""
    settings = context.scene.gsopt
    fine = (*progress_timer.OPEN, "done", "stopped")
    operator.settle(
        lambda: going_on(context.scene), lambda: "" if settings.run_status in fine else settings.run_message
    )
    return f"{settings.run_status} after {settings.run_step} steps" if operator.waits else said


class GSOPT_OT_launch(WaitingOperator, bpy.types.Operator):
    """Learn splats from the dataset, in a process of its own that outlives Blender"""

    bl_idname = "gsopt.launch"
    bl_label = "Launch"

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt
        progress_timer.look(context.scene)
        if going_on(context.scene):
            raise UsageError("A run is going on. Stop it first, or open another scene.")
        chosen = settings.photos if settings.source == "PHOTOS" else settings.dataset
        data = absolute(chosen)
        if not chosen or not data.exists():
            raise InputError("There is no dataset. Render one, choose a folder, or find the poses of photos.")
        work = work_folder(context)
        run = job.free_folder(work / "runs", safe(data))
        folder = job.free_folder(work / "jobs", "train")
        call = arguments.train(python(context), data, run, training(settings), guidance(settings, folder))
        progress_timer.attach(context.scene, run, job.start("train", call, folder, run))
        return follow(context, self, f"Started {run.name}")


def training(settings: Any) -> arguments.Training:
    return arguments.Training(
        preset="" if settings.preset == "own" else settings.preset,
        iterations=settings.iterations,
        downscale=settings.downscale,
        max_gaussians=settings.budget,
        views=settings.views,
        hold_out=settings.hold_out,
        strategy=settings.strategy,
        background=settings.background,
        seed=settings.seed,
        threads=settings.threads,
    )


class GSOPT_OT_resume(WaitingOperator, bpy.types.Operator):
    """Go on with a run that was stopped or killed, from its newest checkpoint"""

    bl_idname = "gsopt.resume"
    bl_label = "Resume"

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt
        progress_timer.look(context.scene)
        if going_on(context.scene) or not settings.run_path:
            raise UsageError("There is no run that waits to go on. Attach to one first.")
        run = absolute(settings.run_path)
        folder = job.free_folder(work_folder(context) / "jobs", "train")
        call = arguments.resume(python(context), run, settings.threads)
        told = run_follower.length(run)
        progress_timer.attach(context.scene, run, job.start("train", call, folder, run), told)
        return follow(context, self, f"{run.name} goes on")


class GSOPT_OT_stop(WaitingOperator, bpy.types.Operator):
    """The run finishes its step, saves and exits; it can go on later"""

    bl_idname = "gsopt.stop"
    bl_label = "Stop"

    kill: bpy.props.BoolProperty(name="End at Once", default=False, options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def do(self, context: Any) -> str:
        found = progress_timer.follower(context.scene)
        if found is None or not going_on(context.scene):
            raise UsageError("No run is going on. Launch one, or attach to one.")
        if self.kill and found.job is not None:
            job.end(found.job, force=True)
        else:
            run_follower.ask_to_stop(found.run.path)
        if self.waits:
            progress_timer.wait(lambda: not going_on(context.scene), 600.0)
        return "Asked to stop"


class GSOPT_OT_attach(ReportingOperator, bpy.types.Operator):
    """Follow a run that is there already"""

    bl_idname = "gsopt.attach"
    bl_label = "Attach"

    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        run = absolute(self.directory)
        if not any((run / name).is_file() for name in ("config.json", "events.jsonl")):
            raise InputError(f"{run} holds no run. Choose the folder that `gsopt train` wrote.")
        progress_timer.attach(context.scene, run)
        progress_timer.look(context.scene)
        return f"{run.name}: {context.scene.gsopt.run_status}"


class GSOPT_OT_follow(ReportingOperator, bpy.types.Operator):
    """For scripts: wait until the run has reached a step or is over"""

    bl_idname = "gsopt.follow"
    bl_label = "Follow"

    step: bpy.props.IntProperty(default=2**31 - 1, min=0)  # type: ignore[valid-type]
    seconds: bpy.props.FloatProperty(default=LONG, min=0.0)  # type: ignore[valid-type]

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt

        def over() -> bool:
            return not going_on(context.scene) or settings.run_step >= self.step

        if not progress_timer.wait(over, self.seconds):
            raise UsageError(f"The run is at step {settings.run_step} after {self.seconds:g} s. Wait longer.")
        return f"{settings.run_status}, step {settings.run_step}"


class GSOPT_OT_list_runs(ReportingOperator, bpy.types.Operator):
    """Look for runs in the work folder"""

    bl_idname = "gsopt.list_runs"
    bl_label = "List Runs"

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt
        settings.runs.clear()
        for path in run_follower.earlier_runs(work_folder(context) / "runs"):
            entry = settings.runs.add()
            entry.name, entry.path = path.name, str(path)
        return f"{len(settings.runs)} runs"


class GSOPT_OT_log(ReportingOperator, bpy.types.Operator):
    """Bring the end of the run's log into a text"""

    bl_idname = "gsopt.log"
    bl_label = "Log"

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt
        said = job.tail(Path(settings.run_path) / "log.txt") if settings.run_path else ""
        output = job.tail(Path(settings.run_job) / job.OUTPUT) if settings.run_job else ""
        text = bpy.data.texts.get("gsopt log") or bpy.data.texts.new("gsopt log")
        text.clear()
        text.write(f"{said}\n{output}" if said or output else "The run has said nothing yet.")
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "TEXT_EDITOR":
                    area.spaces.active.text = text
        return "The log is the text `gsopt log`"


CLASSES = (
    GSOPT_OT_launch,
    GSOPT_OT_resume,
    GSOPT_OT_stop,
    GSOPT_OT_attach,
    GSOPT_OT_follow,
    GSOPT_OT_list_runs,
    GSOPT_OT_log,
)
