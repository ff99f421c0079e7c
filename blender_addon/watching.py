"""The timer: looks at everything that runs outside, for a few milliseconds at a time, and tells the panel.

State that a timer keeps lies here, keyed by scene; what must survive Blender lies in the scene's properties and in the
folders of jobs and runs.
"""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from . import loading, splat_object
from .core import dataset, interpreter, job, prompts
from .core import run as runs
from .core.errors import GsoptError
from .core.statistics import Summary

PAUSE, BUSY = 0.4, 0.02
"""Seconds between two looks, and while splats are handed over."""
KINDS = ("dataset", "poses", "prompts", "doctor")
TIMES: list[float] = []
"""Seconds of CPU that each tick took from the main thread, the newest last."""

_followers: dict[str, runs.Follower] = {}
_loads: dict[str, loading.Loading] = {}


def watch() -> None:
    """Make sure that the timer runs."""
    if not bpy.app.background and not bpy.app.timers.is_registered(tick):
        bpy.app.timers.register(tick, first_interval=0.05, persistent=True)


def forget() -> None:
    """Drop everything that belongs to the file that was open."""
    _followers.clear()
    _loads.clear()
    loading.SUMMARIES.clear()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def pick_up() -> None:
    """After a file was opened: follow what it left running; an import it was saved in the middle of is over."""
    forget()
    for scene in bpy.data.scenes:
        if scene.gsopt.job_import.state == "RUNNING":
            scene.gsopt.job_import.state = "NONE"
        if scene.gsopt.run_status in ("waiting", "running"):
            splat_object.prepare(bpy)
    watch()


def tick() -> float | None:
    """One look at everything; None when there is nothing left to look at."""
    began = time.thread_time()
    busy = [look(scene) for scene in bpy.data.scenes]
    redraw()
    TIMES.append(time.thread_time() - began)
    del TIMES[:-2000]
    if not any(busy):
        return None
    return BUSY if _loads else PAUSE


def look(scene: Any) -> bool:
    """Whether there is something to look at again. A defect of ours becomes a message, never the end of the timer."""
    settings = scene.gsopt
    active = False
    for step in (look_at_jobs, look_at_run, look_at_loading):
        try:
            active = step(scene) or active
        except (GsoptError, ReferenceError) as error:
            settings.message = str(error)
        except Exception as error:
            traceback.print_exc()
            settings.message = f"A defect of the extension: {error!r:.200}. Please report it."
    return active


def redraw() -> None:
    for window in bpy.context.window_manager.windows if bpy.context.window_manager else ():
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                area.tag_redraw()


# Programs


def started(scene: Any, work: job.Job) -> None:
    """Follow a program that was just started."""
    entry = getattr(scene.gsopt, f"job_{work.kind}")
    entry.state, entry.folder, entry.message, entry.share = "RUNNING", work.folder, "", 0.0
    watch()


def look_at_jobs(scene: Any) -> bool:
    active = False
    for kind in KINDS:
        entry = getattr(scene.gsopt, f"job_{kind}")
        if entry.state == "RUNNING":
            look_at_job(scene, kind, entry)
            active = active or entry.state == "RUNNING"
    return active


def look_at_job(scene: Any, kind: str, entry: Any) -> None:
    try:
        work = job.read_job(Path(entry.folder))
        lives = job.alive(work)
        if kind == "dataset" and work.total:
            entry.share = min(1.0, dataset.pictures(Path(work.product)) / work.total)
            entry.message = f"{round(entry.share * work.total)} of {work.total} views"
        elif lives:
            entry.message = job.last_words(work)
        if not lives:
            FINISH[kind](scene, work)
            entry.state, entry.share = "DONE", 1.0
    except GsoptError as error:
        entry.state, entry.message = "FAILED", str(error)
        scene.gsopt.message = str(error)


def finish_dataset(scene: Any, work: job.Job) -> None:
    data = dataset.finished(Path(work.product))
    if data is None:
        raise GsoptError(dataset.failure(Path(work.product)) or job.complaint(work))
    scene.gsopt.dataset, scene.gsopt.source = str(data), "DATASET"


def finish_poses(scene: Any, work: job.Job) -> None:
    if not (Path(work.product) / "transforms.json").is_file():
        raise GsoptError(job.complaint(work))
    scene.gsopt.dataset, scene.gsopt.source = work.product, "DATASET"


def finish_prompts(scene: Any, work: job.Job) -> None:
    if not Path(work.product).is_file():
        raise GsoptError(job.complaint(work))
    found = prompts.read_prompts(Path(work.product))
    about = {key: found.rest[key] for key in ("notes", "object", "domain") if key in found.rest}
    scene.gsopt.prompts_rest = json.dumps(about)
    scene.gsopt.proposals.clear()
    for prompt in found.prompts:
        fill_prompt(scene.gsopt.proposals.add(), prompt)


def finish_doctor(scene: Any, work: job.Job) -> None:
    output = job.tail(Path(work.folder) / job.OUTPUT)
    try:
        scene.gsopt.doctor = interpreter.read_answer(output, work.arguments[0]).line
    except GsoptError as error:
        scene.gsopt.doctor = str(error)
        raise


FINISH: dict[str, Callable[[Any, job.Job], None]] = {
    "dataset": finish_dataset,
    "poses": finish_poses,
    "prompts": finish_prompts,
    "doctor": finish_doctor,
}


def fill_prompt(entry: Any, prompt: prompts.Prompt) -> None:
    """A prompt of a file into an entry of the panel."""
    for name in ("text", "weight", "view", "polarity", "source", "rationale"):
        setattr(entry, name, getattr(prompt, name))
    entry.score = -2.0 if prompt.score is None else prompt.score


def prompt_of(entry: Any) -> prompts.Prompt:
    """The other way round. InputError for an entry that is no prompt."""
    names = ("text", "weight", "view", "polarity", "source", "rationale")
    values = {name: getattr(entry, name) for name in names}
    values["weight"] = round(values["weight"], 6)
    return prompts.Prompt(**values, score=None if entry.score < -1 else round(entry.score, 6))


# The run


def attach(scene: Any, run: Path, work: job.Job | None = None, told: int = 0) -> None:
    """Follow a run from now on, without the first `told` bytes of its events."""
    settings = scene.gsopt
    settings.run_path, settings.run_job = str(run), work.folder if work else ""
    settings.run_status, settings.run_message, settings.run_preview = "waiting", "", ""
    settings.run_step = settings.run_total = settings.run_count = 0
    settings.run_psnr = settings.run_eta = -1.0
    _followers[scene.name_full] = runs.Follower(run, work, told)
    splat_object.prepare(bpy)
    watch()


def follower(scene: Any) -> runs.Follower | None:
    """That of the scene's run; made anew after a file was opened."""
    settings = scene.gsopt
    if not settings.run_path or not settings.run_status:
        return None
    known = _followers.get(scene.name_full)
    if known is None or str(known.run.path) != settings.run_path:
        try:
            work = job.read_job(Path(settings.run_job)) if settings.run_job else None
        except GsoptError:
            work = None  # the folder of the job is gone; the events name the process
        known = _followers[scene.name_full] = runs.Follower(Path(settings.run_path), work)
    return known


def look_at_run(scene: Any) -> bool:
    found = follower(scene)
    if found is None:
        return False
    run, settings = found.poll(), scene.gsopt
    settings.run_status, settings.run_step, settings.run_total = run.status, run.step, run.total
    settings.run_count = run.count
    settings.run_psnr = -1.0 if run.psnr is None else run.psnr
    settings.run_eta = -1.0 if run.eta is None else run.eta
    settings.run_message = run.problem or (run.messages[-1] if run.messages else "")
    if settings.live and run.preview and run.preview != settings.run_preview and "live" not in _loads:
        settings.run_preview = run.preview
        show_live(scene, Path(run.preview))
    return run.status in ("waiting", "running")


def show_live(scene: Any, path: Path) -> None:
    """Bring the newest splats into the viewport, thinned."""
    name = scene.name_full

    def hand_over(mesh: Any, summary: Summary) -> None:
        target = bpy.data.scenes.get(name)
        live = next((o for o in target.objects if o.get("gsopt_live")), None) if target else None
        if live is not None:
            splat_object.replace_mesh(bpy, live, mesh)
        elif target is not None:
            add_object(target, mesh, summary, str(path), "Spheres")["gsopt_live"] = 1

    _loads["live"] = loading.Loading(path, scene.gsopt.live_most, hand_over)
    watch()


# Files


def load(scene: Any, path: Path, finish: Callable[[Any, Summary], None]) -> loading.Loading:
    """Bring a file in; `finish` gets the mesh."""
    entry = scene.gsopt.job_import
    entry.state, entry.message, entry.share = "RUNNING", path.name, 0.0
    _loads["import"] = loading.Loading(path, 0, finish)
    watch()
    return _loads["import"]


def is_importing() -> bool:
    return "import" in _loads


def look_at_loading(scene: Any) -> bool:
    entry = scene.gsopt.job_import
    for name, found in list(_loads.items()):
        try:
            found.advance()
        except BaseException:
            _loads.pop(name, None)
            entry.state = "FAILED" if name == "import" else entry.state
            raise
        if name == "import" and entry.state == "RUNNING":
            entry.share = found.share
        if found.over:
            del _loads[name]
            if found.error:
                scene.gsopt.message = found.error
            if name == "import":
                entry.state, entry.message = ("FAILED" if found.error else "DONE"), found.error
    return bool(_loads)


def add_object(scene: Any, mesh: Any, summary: Summary, came_from: str, display: str) -> Any:
    """An object in the scene's own collection."""
    settings = scene.gsopt
    thing = splat_object.make_object(bpy, scene.collection, mesh, summary.median_size, settings.most_shown, display)
    thing.gsopt.run = came_from
    thing.gsopt.most_shown = settings.most_shown
    thing.gsopt.display = display
    return thing


def wait(scene: Any, over: Callable[[], bool], seconds: float) -> bool:
    """Look again and again where no timer ticks, until it is over or time is up; whether it is over."""
    until = time.monotonic() + seconds
    while True:
        tick()
        if over():
            return True
        if time.monotonic() > until:
            return False
        time.sleep(0.05)
