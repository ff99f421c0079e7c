"""The timer: polls everything that runs outside, for a few milliseconds at a time, and updates the panel.

State that a timer keeps lies here, keyed by scene; what must survive Blender lies in the scene's properties and in the
folders of jobs and runs.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy

from . import loading, splat_object
from .core import dataset, job, run_follower
from .core.errors import GsoptError
from .core.statistics import Summary
from .job_results import FINISH

PAUSE, BUSY = 0.4, 0.02
"""Seconds between two looks, and while splats are handed over."""
KINDS = ("dataset", "poses", "masks", "prompts", "doctor", "install", "page", "clean", "mesh", "measure")
OPEN = ("waiting", "running")
"""States of a run that is going on."""
LIVE = "gsopt_live"
"""Custom property of the object that shows a run's newest splats."""
TIMES: list[float] = []
"""Seconds of CPU that each tick took from the main thread, the newest last."""

_followers: dict[int, run_follower.Follower] = {}
_loads: dict[tuple[int, str], loading.Loading] = {}
_kept: dict[int, list[Any]] = {}


def watch() -> None:
    """Register the timer unless it runs."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.05, persistent=True)


def forget() -> None:
    """Drop everything that belongs to the file that was open."""
    for kept in (_followers, _loads, _kept, loading.SUMMARIES):
        kept.clear()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def pick_up() -> None:
    """After a file was opened: follow what it left running; an import it was saved in the middle of is over."""
    forget()
    for scene in bpy.data.scenes:
        if scene.gsopt.job_import.state == "RUNNING":
            scene.gsopt.job_import.state = "NONE"
    watch()


def tick() -> float | None:
    """Polls everything once. Returns the pause until the next poll, None when nothing is left."""
    began = time.thread_time()
    busy = [look(scene) for scene in bpy.data.scenes]
    redraw()
    TIMES.append(time.thread_time() - began)
    del TIMES[:-2000]
    if not any(busy):
        return None
    return BUSY if _loads else PAUSE


def look(scene: Any) -> bool:
    """Polls a scene; true when it must be polled again. A defect becomes a message and never stops the timer."""
    settings = scene.gsopt
    for step in (look_at_jobs, look_at_run, look_at_loading):
        try:
            step(scene)
        except GsoptError as error:
            settings.message = str(error)
        except ReferenceError:
            settings.message = "An undo took away what was being brought in. Import it again."
        except Exception as error:
            traceback.print_exc()
            settings.message = f"A defect of the extension: {error!r:.200}. Please report it."
    jobs = any(getattr(settings, f"job_{kind}").state == "RUNNING" for kind in KINDS)
    return jobs or settings.run_status in OPEN or any(owner == scene.session_uid for owner, _ in _loads)


def redraw() -> None:
    """The panel and the preferences; the viewport draws itself when its splats change."""
    for window in bpy.context.window_manager.windows if bpy.context.window_manager else ():
        for area in window.screen.areas:
            for region in area.regions:
                if (area.type, region.type) in (("VIEW_3D", "UI"), ("PREFERENCES", "WINDOW")):
                    region.tag_redraw()


def assign_changed(entry: Any, **values: Any) -> None:
    """Assign only values that differ, because every assignment makes Blender check for redraws."""
    for name, value in values.items():
        if getattr(entry, name) != value:
            setattr(entry, name, value)


# Undo takes scenes back to what they were, but a program that was started goes on.


def lasting(settings: Any) -> Iterator[tuple[Any, str]]:
    """Yields owner and name of each property that no undo may take back: the state of runs and programs."""
    for name in settings.bl_rna.properties.keys():  # noqa: SIM118  a collection of Blender's
        if name.startswith("run_"):
            yield settings, name
        elif name.startswith("job_"):
            yield from ((getattr(settings, name), part) for part in ("state", "folder", "message", "share"))


def before_undo() -> None:
    for scene in bpy.data.scenes:
        _kept[scene.session_uid] = [getattr(owner, name) for owner, name in lasting(scene.gsopt)]


def after_undo() -> None:
    for scene in bpy.data.scenes:
        for (owner, name), value in zip(lasting(scene.gsopt), _kept.pop(scene.session_uid, ()), strict=False):
            assign_changed(owner, **{name: value})
    watch()


def undo_step(name: str) -> None:
    """Something was done that no operator's own undo step covers."""
    if not bpy.app.background:
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.ed.undo_push(message=name)


# Programs


def started(scene: Any, work: job.Job) -> None:
    """Follow a program that was just started."""
    entry = getattr(scene.gsopt, f"job_{work.kind}")
    entry.state, entry.folder, entry.message, entry.share = "RUNNING", work.folder, "", 0.0
    watch()


def look_at_jobs(scene: Any) -> None:
    for kind in KINDS:
        entry = getattr(scene.gsopt, f"job_{kind}")
        if entry.state == "RUNNING":
            look_at_job(scene, kind, entry)


def look_at_job(scene: Any, kind: str, entry: Any) -> None:
    try:
        work = job.read_job(Path(entry.folder))
        lives = job.alive(work)
        if kind == "dataset" and work.total:
            made = min(dataset.pictures(Path(work.product)), work.total)
            assign_changed(entry, share=made / work.total, message=f"{made} of {work.total} views")
        elif lives:
            assign_changed(entry, message=job.last_words(work))
        if not lives:
            FINISH[kind](scene, work)
            entry.state, entry.share = "DONE", 1.0
            undo_step(f"gsopt: {kind}")
    except GsoptError as error:
        entry.state, entry.message = "FAILED", str(error)
        scene.gsopt.message = str(error)


# The run


def attach(scene: Any, run: Path, work: job.Job | None = None, told: int = 0) -> None:
    """Follow a run from now on, without the first `told` bytes of its events."""
    settings = scene.gsopt
    settings.run_path, settings.run_job = str(run), work.folder if work else ""
    settings.run_status, settings.run_message, settings.run_preview = "waiting", "", ""
    settings.run_step = settings.run_total = settings.run_count = 0
    settings.run_psnr = settings.run_eta = -1.0
    _followers[scene.session_uid] = run_follower.Follower(run, work, told)
    watch()


def follower(scene: Any) -> run_follower.Follower | None:
    """Returns the follower of the scene's run; creates it again after a file was opened."""
    settings = scene.gsopt
    if not settings.run_path or not settings.run_status:
        return None
    known = _followers.get(scene.session_uid)
    if known is None or str(known.run.path) != settings.run_path:
        try:
            work = job.read_job(Path(settings.run_job)) if settings.run_job else None
        except GsoptError:
            work = None  # the folder of the job is gone; the events name the process
        known = _followers[scene.session_uid] = run_follower.Follower(Path(settings.run_path), work)
    return known


def look_at_run(scene: Any) -> None:
    found = follower(scene)
    if found is None:
        return
    run, settings = found.poll(), scene.gsopt
    psnr, eta = (-1.0 if value is None else value for value in (run.psnr, run.eta))
    assign_changed(settings, run_status=run.status, run_step=run.step, run_total=run.total, run_count=run.count)
    assign_changed(
        settings, run_psnr=psnr, run_eta=eta, run_message=run.problem or (run.messages[-1] if run.messages else "")
    )
    if settings.live and run.preview not in ("", settings.run_preview) and (scene.session_uid, "live") not in _loads:
        settings.run_preview = run.preview
        _loads[scene.session_uid, "live"] = loading.Loading([Path(run.preview)], settings.live_most, show_live)


def show_live(scene: Any, mesh: Any, summary: Summary) -> Iterator[None]:
    """Bring the newest splats into the viewport."""
    yield
    live = live_object(scene)
    if live is None:
        live = add_object(scene, mesh, summary, scene.gsopt.run_path, "Ellipsoids")
        live.name, live[LIVE] = f"{Path(scene.gsopt.run_path).name} (live)", 1
    else:
        splat_object.replace_mesh(bpy, live, mesh)


def live_object(scene: Any) -> Any:
    """The object that shows the run's newest splats, or None."""
    return next((thing for thing in scene.objects if thing.get(LIVE)), None)


# Files


def load(scene: Any, paths: list[Path], finish: loading.Finish, most: int = 0) -> None:
    """Bring files in, `most` splats of each where it is not 0; `finish` gets every mesh."""
    entry = scene.gsopt.job_import
    entry.state, entry.message, entry.share = "RUNNING", paths[0].name, 0.0
    _loads[scene.session_uid, "import"] = loading.Loading(paths, most, finish)
    watch()


def look_at_loading(scene: Any) -> None:
    entry = scene.gsopt.job_import
    for key in [key for key in _loads if key[0] == scene.session_uid]:
        found, state = _loads.pop(key), "FAILED"
        try:
            if not found.advance(scene):
                _loads[key], state = found, "RUNNING"
            elif not found.error:
                state = "DONE"
        finally:
            if key[1] == "import":
                assign_changed(entry, state=state, share=found.share, message=found.error or found.path.name)
        if state == "FAILED":
            raise GsoptError(found.error)


def add_object(scene: Any, mesh: Any, summary: Summary, came_from: str, display: str) -> Any:
    """An object in the scene's own collection."""
    settings = scene.gsopt
    thing = splat_object.make_object(bpy, scene.collection, mesh, summary.median_size, settings.most_shown, display)
    thing.gsopt.run = came_from
    thing.gsopt.most_shown = settings.most_shown
    thing.gsopt.display = display
    return thing


def wait(over: Callable[[], bool], seconds: float) -> bool:
    """Look again and again where no timer ticks, until it is over or time is up; whether it is over."""
    until = time.monotonic() + seconds
    while True:
        tick()
        if over():
            return True
        if time.monotonic() > until:
            return False
        time.sleep(0.02 if _loads else 0.05)
