"""A real Blender window: every panel at its work, pictures of all of it, and how long the window had to wait.

    blender --factory-startup -P tests/blender/gui.py -- OUT DATASET

`make test-blender-gui` starts it on a virtual screen. A mesh is rendered, a language model (a scripted one) proposes
prompts, gsopt learns from DATASET while the window is watched, the result and a million splats are imported. Writes
OUT/*.png (with `scrot`) and OUT/found.json.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "blender")]

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from made_splats import random_splats  # noqa: E402
from scripted_server import completion, serving  # noqa: E402

import blender_addon  # noqa: E402
from blender_addon import progress_timer  # noqa: E402
from blender_addon.core.ply import write_ply  # noqa: E402

PATIENCE = 900.0
"""Seconds that a step may take on a slow machine."""
SAMPLING = 40.0
"""Seconds for a viewport to gather its samples."""
STEPS, ENOUGH = 10_000, 1000
"""Steps of the run, and the step after which it is stopped: it must not end before the slowest window has shown it."""
WRITTEN = {
    "front": [{"text": "a russet hen with a red comb, seen from the front", "why": "named in the notes"}],
    "back": [{"text": "the tail of a hen, dark green feathers", "why": "No photo shows the back."}],
    "negative": [{"text": "blurry, floating specks", "why": "What splats do where nothing holds them."}],
}

Story = Iterator[float]
"""Yields seconds to wait, in which the window lives on."""


def view() -> tuple[Any, Any, Any, Any]:
    """Window, area, its space and the sidebar's region."""
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    return window, area, area.spaces.active, next(r for r in area.regions if r.type == "UI")


def until(true: Callable[[], Any]) -> Story:
    end = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > end:
            raise TimeoutError("the window did not get there")
        yield 0.1


def shoot(out: Path, name: str, seconds: float = 2.0) -> Story:
    """A picture of the window, again and again until something is to be seen in the middle of the viewport: without a
    graphics card compiling shaders takes minutes."""
    path = out / f"{name}.png"
    end, seen = time.monotonic() + PATIENCE, 0
    while seen < 2:  # the panel may still be moving in the first one
        if time.monotonic() > end:
            raise TimeoutError(f"nothing is to be seen in {path.name}")
        view()[1].tag_redraw()
        yield seconds
        subprocess.run(["scrot", "--overwrite", str(path)], check=True)
        seen += is_something_in(path)


def is_something_in(path: Path) -> bool:
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    middle = values.reshape(height, width, 4)[height // 3 : height * 2 // 3, width // 3 : width // 2, :3]
    return bool(middle.std(axis=(0, 1)).max() > 0.03)


def timed(found: dict[str, Any], operator: Any, **settings: Any) -> None:
    """Press a button; the CPU time that its call takes from the main thread is told."""
    began = time.thread_time()
    operator(**settings)
    found.setdefault("buttons, ms of CPU", {})[operator.idname()] = round(1000 * (time.thread_time() - began), 1)


def longest_tick(found: dict[str, Any], what: str) -> None:
    found.setdefault("longest tick, ms of CPU", {})[what] = round(1000 * max(progress_timer.TIMES), 1)
    progress_timer.TIMES.clear()


def set_up(out: Path) -> None:
    window, area, space, _ = view()
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.system.use_region_overlap = False
    bpy.context.preferences.addons.new().module = "blender_addon"
    blender_addon.register()
    for other in list(bpy.data.objects):
        bpy.data.objects.remove(other)
    space.show_region_ui = True
    space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_cursor = False
    bpy.context.scene.eevee.taa_samples = 4  # without a graphics card every sample takes seconds
    bpy.context.scene.view_settings.view_transform = "Standard"
    settings = bpy.context.scene.gsopt
    settings.folder, settings.threads, settings.prior = str(out / "work"), 1, "off"
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.screen.screen_full_area()


def show_sidebar() -> None:
    _, area, space, sidebar = view()
    space.show_region_ui = True
    sidebar.active_panel_category = "gsopt"
    area.tag_redraw()


def scroll(pages: int) -> None:
    window, area, _, sidebar = view()
    with bpy.context.temp_override(window=window, area=area, region=sidebar):
        for _ in range(abs(pages)):
            (bpy.ops.view2d.scroll_down if pages > 0 else bpy.ops.view2d.scroll_up)(page=True)


def frame(thing: Any) -> None:
    """Look at an object from the front, a little from the side and from above."""
    window, area, _, _ = view()
    region = next(r for r in area.regions if r.type == "WINDOW")
    bpy.context.view_layer.objects.active = thing
    thing.select_set(True)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.view3d.view_orbit(angle=0.5, type="ORBITRIGHT")
        bpy.ops.view3d.view_orbit(angle=0.35, type="ORBITUP")
        bpy.ops.view3d.view_selected()
    thing.select_set(False)


def source(out: Path, found: dict[str, Any]) -> Story:
    """A mesh is rendered in a Blender of its own; `gsopt doctor` is asked."""
    settings = bpy.context.scene.gsopt
    with bpy.context.temp_override(window=view()[0]):
        bpy.ops.mesh.primitive_monkey_add()
        frame(bpy.context.object)
        bpy.context.object.select_set(True)
    timed(found, bpy.ops.gsopt.test)
    yield from until(lambda: settings.job_doctor.state != "RUNNING")
    found["doctor"] = settings.doctor
    settings.render_views, settings.render_size, settings.render_samples = 44, 128, 8
    timed(found, bpy.ops.gsopt.render_dataset)
    bpy.context.object.select_set(False)
    yield from until(lambda: settings.job_dataset.share > 0.1 or settings.job_dataset.state != "RUNNING")
    yield from shoot(out, "1_source", 0.5)
    yield from until(lambda: settings.job_dataset.state != "RUNNING")
    found["dataset"] = [settings.job_dataset.state, settings.job_dataset.message]
    view()[2].shading.type = "MATERIAL"


def guidance(out: Path, found: dict[str, Any]) -> Story:
    """Proposals of a language model: the first is accepted, the second edited, the last looked at."""
    settings = bpy.context.scene.gsopt
    preferences = bpy.context.preferences.addons["blender_addon"].preferences
    settings.notes = "hen, russet feathers, red comb, dark tail"
    with serving([completion(json.dumps(WRITTEN))]) as server:
        preferences.llm, preferences.model = server.url, "tiny"
        timed(found, bpy.ops.gsopt.propose)
        yield from until(lambda: settings.job_prompts.state != "RUNNING")
    found["proposals"] = len(settings.proposals)
    for _ in range(2):
        bpy.ops.gsopt.proposal(accept=True)
    yield from shoot(out, "2_guidance")
    bpy.data.objects.remove(bpy.context.view_layer.objects.active)


def run(out: Path, data: Path, found: dict[str, Any]) -> Story:
    """A real run, watched; an undo in the middle of it."""
    settings = bpy.context.scene.gsopt
    settings.source, settings.dataset = "DATASET", str(data)
    settings.preset, settings.iterations = "own", STEPS
    progress_timer.undo_step("before the run")
    progress_timer.TIMES.clear()
    timed(found, bpy.ops.gsopt.launch)
    yield from until(lambda: progress_timer.live_object(bpy.context.scene) or not settings.run_status)
    live = progress_timer.live_object(bpy.context.scene)
    frame(live)
    scroll(1)
    yield from shoot(out, "3_run")
    yield from until(lambda: settings.run_step > ENOUGH or settings.run_status not in progress_timer.OPEN)
    yield from shoot(out, "3_run")
    found["seen running"] = [settings.run_status, settings.run_step, len(live.data.vertices)]
    progress_timer.undo_step("something")
    with bpy.context.temp_override(window=view()[0]):
        bpy.ops.ed.undo()
    settings = bpy.context.scene.gsopt
    found["after an undo"] = settings.run_status
    timed(found, bpy.ops.gsopt.stop)
    yield from until(lambda: bpy.context.scene.gsopt.run_status not in progress_timer.OPEN)
    settings = bpy.context.scene.gsopt
    found["run"] = [settings.run_status, settings.run_step, settings.run_count]
    longest_tick(found, "while it ran")


def imported(out: Path, data: Path, found: dict[str, Any]) -> Story:
    """The result: its statistics, an undo, as it is seen through an input camera, and as a point cloud."""
    timed(found, bpy.ops.gsopt.import_splats, from_run=True)
    yield from until(lambda: bpy.context.scene.gsopt.job_import.state != "RUNNING")
    longest_tick(found, "of the import")

    def count() -> list[int]:
        return [len(o.data.vertices) for o in bpy.context.scene.objects if o.type == "MESH"]

    found["imported, undone, done again"] = [count()]
    for operator in (bpy.ops.ed.undo, bpy.ops.ed.redo):
        with bpy.context.temp_override(window=view()[0]):
            operator()
        found["imported, undone, done again"].append(count())
    thing = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    frame(thing)
    timed(found, bpy.ops.gsopt.statistics)
    scroll(3)
    bpy.context.scene.eevee.taa_samples = 8
    yield SAMPLING
    yield from shoot(out, "4_inspect")
    thing.gsopt.size = 0.25
    yield SAMPLING
    yield from shoot(out, "5_as_a_point_cloud")
    thing.gsopt.size = 1.0
    bpy.ops.gsopt.import_cameras(directory=str(data))
    bpy.ops.gsopt.look_through()
    yield SAMPLING
    yield from shoot(out, "6_through_a_camera")


def a_million(out: Path, found: dict[str, Any]) -> Story:
    """The most that a tick takes while a large file comes in."""
    settings = bpy.context.scene.gsopt
    view()[2].shading.type = "SOLID"
    write_ply(out / "million.ply", random_splats(1_000_000))
    settings.display = "Points"
    progress_timer.TIMES.clear()
    bpy.ops.gsopt.import_splats(filepath=str(out / "million.ply"))
    yield from until(lambda: settings.job_import.state != "RUNNING")
    found["a million"] = [settings.job_import.state, len(bpy.context.view_layer.objects.active.data.vertices)]
    longest_tick(found, "of the import of a million")
    (out / "million.ply").unlink()


def story(out: Path, data: Path, found: dict[str, Any]) -> Story:
    set_up(out)
    yield 1.0
    show_sidebar()
    yield from source(out, found)
    yield from guidance(out, found)
    yield from run(out, data, found)
    yield from imported(out, data, found)
    yield from a_million(out, found)
    blender_addon.unregister()
    found["timers left"] = bpy.app.timers.is_registered(progress_timer.tick)


def main(out: Path, data: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {"blender": bpy.app.version_string}
    steps = story(out, data, found)

    def go_on() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            found["ok"] = True
        except Exception:
            found["error"] = traceback.format_exc()
        (out / "found.json").write_text(json.dumps(found, indent=1))
        bpy.ops.wm.quit_blender()
        return None

    bpy.app.timers.register(go_on, first_interval=2.0)


if __name__ == "__main__":
    words = [Path(word).absolute() for word in sys.argv[sys.argv.index("--") + 1 :]]
    main(words[0], words[1])
