"""The whole way in Blenders without a window: mesh, dataset, prompts, run, and in the middle of it Blender dies. The
next one finds the run, stops it, goes on with it, imports, filters, exports.

    blender -b --factory-startup -P tests/blender/end_to_end.py -- WORK [MESH]
    blender -b --factory-startup -P tests/blender/end_to_end.py -- WORK --again
    (or with a Python that has the module bpy: python tests/blender/end_to_end.py -- ...)

Prints what it found as one line of JSON, beginning with `found `. Every step is an operator of the panel.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402
import numpy as np  # noqa: E402

import blender_addon  # noqa: E402
from blender_addon import splat_object  # noqa: E402

VIEWS, TEST_VIEWS, SIZE = 6, 2, 48
SCENE = "scene.blend"


def call(operator: Any, **settings: Any) -> None:
    assert operator(**settings) == {"FINISHED"}, operator


def bring_mesh(path: Path | None) -> None:
    """The mesh, or Blender's monkey, selected."""
    for other in list(bpy.data.objects):
        bpy.data.objects.remove(other)
    if path is None:
        bpy.ops.mesh.primitive_monkey_add(location=(3, -2, 1))
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
    bpy.ops.object.select_all(action="SELECT")
    for part in bpy.context.selected_objects:
        part.location, part.rotation_euler, part.scale = (3, -2, 1), (0.4, 0.2, 1.1), [5 * s for s in part.scale]


def box(things: list[Any]) -> Any:
    """[2, 3] least and greatest corner of what objects' points fill in the world."""
    worlds = [(np.array(t.matrix_world), splat_object.get(t.data, "position")) for t in things]
    points = np.concatenate([points @ world[:3, :3].T + world[:3, 3] for world, points in worlds])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def misplaced(splats: Any) -> float:
    """Distance of the splats' box from the box of their meshes, as a share of its size."""
    meshes = box([o for o in bpy.context.scene.objects if o.type == "MESH" and not splat_object.is_splats(o)])
    return float(np.abs(box([splats]) - meshes).max() / np.ptp(meshes, axis=0).max())


def prepare(work: Path) -> Any:
    settings = bpy.context.scene.gsopt
    settings.folder = str(work)
    settings.render_views, settings.render_test_views = VIEWS, TEST_VIEWS
    settings.render_size, settings.render_samples = SIZE, 2
    settings.threads, settings.prior = 1, "off"
    settings.preset, settings.iterations = "own", 4000
    return settings


def write_prompts(settings: Any, work: Path) -> list[str]:
    call(bpy.ops.gsopt.prompt_add, text="a small carved figure, 春")
    call(bpy.ops.gsopt.prompt_add, text="blurry", polarity="negative")
    call(bpy.ops.gsopt.prompts_write, filepath=str(work / "prompts.json"))
    settings.prompts.clear()
    call(bpy.ops.gsopt.prompts_read, filepath=str(work / "prompts.json"))
    return [entry.text for entry in settings.prompts]


def launch(found: dict[str, Any]) -> None:
    settings = bpy.context.scene.gsopt
    call(bpy.ops.gsopt.launch, wait=False)
    call(bpy.ops.gsopt.follow, step=20, seconds=1800.0)
    found["seen running"] = [settings.run_status, settings.run_step, settings.run_total, settings.run_count]
    bpy.ops.wm.save_as_mainfile(filepath=str(Path(settings.folder) / SCENE))


def find_again(found: dict[str, Any], work: Path) -> None:
    """Open the file of the Blender that died; stop the run, go on with it, stop it again."""
    bpy.ops.wm.open_mainfile(filepath=str(work / SCENE))
    settings = bpy.context.scene.gsopt
    found["saved"] = [settings.run_status, settings.run_step, [entry.text for entry in settings.prompts]]
    call(bpy.ops.gsopt.follow, step=settings.run_step + 5, seconds=1800.0)
    found["found again"] = [settings.run_status, settings.run_step]
    call(bpy.ops.gsopt.stop)
    found["stopped"] = [settings.run_status, settings.run_step]
    settings.run_status = ""
    call(bpy.ops.gsopt.list_runs)
    call(bpy.ops.gsopt.attach, directory=settings.runs[0].path)
    found["attached"] = settings.run_status
    call(bpy.ops.gsopt.resume, wait=False)
    call(bpy.ops.gsopt.follow, step=found["stopped"][1] + 5, seconds=1800.0)
    found["resumed"] = [settings.run_status, settings.run_step]
    call(bpy.ops.gsopt.stop)


def inspect(found: dict[str, Any], work: Path) -> None:
    settings = bpy.context.scene.gsopt
    call(bpy.ops.gsopt.import_splats, from_run=True)
    thing = bpy.context.view_layer.objects.active
    found["imported"] = len(thing.data.vertices)
    bpy.context.view_layer.update()
    found["misplaced"] = misplaced(thing)
    call(bpy.ops.gsopt.import_cameras)
    call(bpy.ops.gsopt.look_through)
    found["cameras"] = sum(o.type == "CAMERA" for o in bpy.context.scene.objects)
    settings.least_opacity = 0.2
    call(bpy.ops.gsopt.filter)
    call(bpy.ops.gsopt.delete_hidden)
    found["kept"] = len(thing.data.vertices)
    call(bpy.ops.gsopt.export, filepath=str(work / "edited splats.ply"))
    bpy.ops.wm.save_mainfile()


def until_it_dies(work: Path, mesh: Path | None) -> None:
    bring_mesh(mesh)
    settings = prepare(work)
    found: dict[str, Any] = {"blender": bpy.app.version_string}
    call(bpy.ops.gsopt.test)
    found["doctor"] = settings.doctor
    call(bpy.ops.gsopt.render_dataset)
    found["dataset"] = settings.job_dataset.message
    found["prompts"] = write_prompts(settings, work)
    launch(found)
    print("found " + json.dumps(found), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)


def again(work: Path) -> None:
    found: dict[str, Any] = {}
    find_again(found, work)
    inspect(found, work)
    blender_addon.unregister()
    found["left behind"] = [name for name in ("Scene", "Object") if hasattr(getattr(bpy.types, name), "gsopt")]
    print("found " + json.dumps(found), flush=True)


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :]
    folder = Path(words[0]).absolute()
    bpy.ops.wm.read_factory_settings(use_empty=False)
    blender_addon.register()
    if words[1:] == ["--again"]:
        again(folder)
    else:
        until_it_dies(folder, Path(words[1]).absolute() if len(words) > 1 else None)
