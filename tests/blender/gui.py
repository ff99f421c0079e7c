"""A real Blender window: the panel drawn, a run followed live, splats imported by the timer, pictures of all of it.

    blender --factory-startup -P tests/blender/gui.py -- OUT SPLATS.ply [DATASET]

`make test-blender-gui` starts it on a virtual screen. Writes OUT/*.png (with `scrot`) and OUT/found.json.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402

import blender_addon  # noqa: E402
from blender_addon import watching  # noqa: E402

PATIENCE = 600.0
"""Seconds that a step may take on a slow machine."""


def view() -> tuple[Any, Any, Any, Any]:
    """Window, area, its space and the sidebar's region."""
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    return window, area, area.spaces.active, next(r for r in area.regions if r.type == "UI")


def shoot(out: Path, name: str) -> None:
    subprocess.run(["scrot", "--overwrite", str(out / f"{name}.png")], check=True)


def until(true: Any) -> Iterator[float]:
    end = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > end:
            raise TimeoutError("the window did not get there")
        yield 0.1


def settle() -> Iterator[float]:
    """Let the window draw what has changed."""
    view()[1].tag_redraw()
    yield 1.0
    view()[1].tag_redraw()
    yield 2.0


def set_up() -> None:
    window, area, space, _ = view()
    bpy.context.preferences.view.show_splash = False
    for other in list(bpy.data.objects):
        bpy.data.objects.remove(other)
    space.show_region_ui = True
    space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = False
    bpy.context.scene.eevee.taa_samples = 1  # without a graphics card every sample takes seconds
    space.shading.type = "SOLID"
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


def frame_selected() -> None:
    window, area, _, _ = view()
    region = next(r for r in area.regions if r.type == "WINDOW")
    active = bpy.context.view_layer.objects.active
    active.select_set(True)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.view3d.view_orbit(angle=0.5, type="ORBITRIGHT")
        bpy.ops.view3d.view_orbit(angle=0.35, type="ORBITUP")
        bpy.ops.view3d.view_selected()
    active.select_set(False)


def fill_guidance() -> None:
    settings = bpy.context.scene.gsopt
    settings.notes = "wooden lantern, brass fittings, worn edges"
    for text, polarity in (
        ("a wooden lantern with brass fittings", "positive"),
        ("blurry, floating specks", "negative"),
    ):
        bpy.ops.gsopt.prompt_add(text=text, polarity=polarity)
    entry = settings.proposals.add()
    entry.text, entry.source, entry.view = "the back of the lantern: a plain door with a hinge", "template", "back"
    entry.rationale = "No photo shows the back."


def story(out: Path, splats: Path, data: Path | None, found: dict[str, Any]) -> Iterator[float]:
    set_up()
    yield 1.0
    show_sidebar()
    yield from settle()
    settings = bpy.context.scene.gsopt
    shoot(out, "1_source")
    fill_guidance()
    yield from settle()
    shoot(out, "2_guidance")
    run = out / "run"
    script = Path(__file__).with_name("stand_in_run.py")
    python = sys.executable
    process = subprocess.Popen([python, str(script), str(run), str(splats), "60"])
    yield from until((run / "events.jsonl").exists)
    watching.TIMES.clear()
    bpy.ops.gsopt.attach(directory=str(run))
    yield from until(lambda: any(o.get("gsopt_live") for o in bpy.data.objects) or settings.run_status == "done")
    scroll(1)
    yield from settle()
    shoot(out, "3_run")
    yield from until(lambda: settings.run_status not in ("waiting", "running"))
    found["run"] = [settings.run_status, settings.run_step, settings.run_count]
    found["longest tick while it ran, ms of CPU"] = round(1000 * max(watching.TIMES), 1)
    process.wait()
    watching.TIMES.clear()
    bpy.ops.gsopt.import_splats(filepath=str(splats))
    yield from until(lambda: settings.job_import.state != "RUNNING")
    found["imported"] = [settings.job_import.state, len(bpy.context.view_layer.objects.active.data.vertices)]
    found["longest tick of the import, ms of CPU"] = round(1000 * max(watching.TIMES), 1)
    yield from look(out, data)
    blender_addon.unregister()
    found["timers left"] = bpy.app.timers.is_registered(watching.tick)


def look(out: Path, data: Path | None) -> Iterator[float]:
    """The imported splats, from the side and through an input camera."""
    frame_selected()
    bpy.ops.gsopt.statistics()
    scroll(3)
    view()[2].shading.type = "MATERIAL"
    yield from settle()
    yield 10.0
    shoot(out, "4_inspect")
    if data is not None:
        bpy.ops.gsopt.import_cameras(directory=str(data))
        bpy.ops.gsopt.look_through()
        yield from settle()
        yield 10.0
        shoot(out, "5_through_a_camera")


def main(out: Path, splats: Path, data: Path | None) -> None:
    out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {"blender": bpy.app.version_string}
    blender_addon.register()
    steps = story(out, splats, data, found)

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
    main(words[0], words[1], words[2] if len(words) > 2 else None)
