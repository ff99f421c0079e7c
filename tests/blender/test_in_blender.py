"""The half that needs Blender: what comes in goes out the same, filters hide what they say, faults end in a message."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_splats import random_splats

from blender_addon.core.ply import read_ply, write_ply

SHOWN = {"Points": 0, "Spheres": 0, "Ellipsoids": 100, "Gaussians": 100}


@pytest.fixture
def panel(tmp_path: Path) -> Iterator[Any]:
    """An empty scene with the extension enabled; its settings."""
    bpy = pytest.importorskip("bpy", reason="Blender's module is not installed (pip install bpy)")
    import blender_addon

    bpy.ops.wm.read_factory_settings(use_empty=True)
    entry = bpy.context.preferences.addons.new()
    entry.module = "blender_addon"
    blender_addon.register()
    try:
        bpy.context.scene.gsopt.folder = str(tmp_path / "work")
        yield bpy.context.scene.gsopt
    finally:
        blender_addon.unregister()
        bpy.context.preferences.addons.remove(entry)


def bring_in(path: Path, count: int = 100) -> Any:
    """Splats as an object, through the operator."""
    import bpy

    write_ply(path, random_splats(count))
    assert bpy.ops.gsopt.import_splats(filepath=str(path)) == {"FINISHED"}
    return bpy.context.view_layer.objects.active


def fails_with(said: str, operator: Any, **settings: Any) -> None:
    """The operator is cancelled with a message in the panel; in a script that is a RuntimeError."""
    import bpy

    with pytest.raises(RuntimeError, match="Error: "):
        operator(**settings)
    assert said in bpy.context.scene.gsopt.message
    assert "Traceback" not in bpy.context.scene.gsopt.message


def test_what_comes_in_goes_out_the_same(panel: Any, odd_folder: Path) -> None:
    import bpy

    bring_in(odd_folder / "a b.ply")
    bpy.ops.gsopt.export(filepath=str(odd_folder / "out.ply"))
    before, after = read_ply(odd_folder / "a b.ply"), read_ply(odd_folder / "out.ply")
    for name in ("positions", "scales", "rotations", "opacities", "base", "sh"):
        assert np.allclose(getattr(before, name), getattr(after, name), rtol=1e-5, atol=1e-6), name


@pytest.mark.parametrize("display", list(SHOWN))
def test_each_display_shows_every_splat_that_is_chosen(panel: Any, tmp_path: Path, display: str) -> None:
    import bpy

    thing = bring_in(tmp_path / "a.ply")
    thing.gsopt.display = display

    def count() -> int:
        bpy.context.view_layer.update()
        return sum(i.is_instance for i in bpy.context.evaluated_depsgraph_get().object_instances)

    extra = 0 if SHOWN[display] else count()
    assert count() == SHOWN[display] + extra
    if SHOWN[display]:
        opacities = read_ply(tmp_path / "a.ply").opacities
        thing.gsopt.least_opacity = 0.5
        assert count() == (opacities >= 0.5).sum()
        thing.gsopt.least_opacity, thing.gsopt.most_shown = 0.0, 30
        assert count() == 25, "every fourth of 100"


def test_filters_hide_and_deleting_keeps_the_rest(panel: Any, tmp_path: Path) -> None:
    import bpy
    from mathutils import Matrix

    thing = bring_in(tmp_path / "a.ply")
    splats = read_ply(tmp_path / "a.ply")
    thing.matrix_world = Matrix(((2, 0, 0, 5), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 1)))
    box = bpy.data.objects.new("box", bpy.data.meshes.new("box"))
    box.data.from_pydata([(-1, -1, -1), (1, 1, 1)], [], [])
    box.location, box.scale = (5, 0, 0), (2, 1, 3)
    bpy.context.scene.collection.objects.link(box)
    bpy.context.view_layer.update()
    panel.least_opacity, panel.box = 0.3, box
    bpy.ops.gsopt.filter()
    inside = (np.abs(splats.positions) <= (1, 0.5, 1.5)).all(axis=1) & (splats.opacities >= 0.3)
    assert 0 < inside.sum() < 100
    bpy.ops.gsopt.export(filepath=str(tmp_path / "seen.ply"))
    assert np.allclose(read_ply(tmp_path / "seen.ply").positions, splats.positions[inside])
    bpy.ops.gsopt.delete_hidden()
    assert len(thing.data.vertices) == inside.sum()
    fails_with("No splat is hidden", bpy.ops.gsopt.delete_hidden)


def test_edits_in_blender_reach_the_file(panel: Any, tmp_path: Path) -> None:
    """Vertices deleted by Blender's own tools take their attributes with them."""
    import bmesh
    import bpy

    thing = bring_in(tmp_path / "a.ply")
    edit = bmesh.new()
    edit.from_mesh(thing.data)
    edit.verts.ensure_lookup_table()
    bmesh.ops.delete(edit, geom=edit.verts[:40], context="VERTS")
    edit.to_mesh(thing.data)
    edit.free()
    bpy.ops.gsopt.export(filepath=str(tmp_path / "b.ply"))
    rest = read_ply(tmp_path / "a.ply").rows(slice(40, None))
    after = read_ply(tmp_path / "b.ply")
    assert np.array_equal(after.sh, rest.sh)
    assert np.allclose(after.rotations, rest.rotations, atol=1e-6)


def test_cameras_look_where_the_poses_say(panel: Any, tmp_path: Path) -> None:
    import bpy
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    pose = [[0, 0, 1, 4], [1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 0, 1]]
    lens = {"fl_x": 120.0, "w": 200, "h": 100, "cx": 90.0, "cy": 60.0}
    frames = [{"file_path": "a.png", "transform_matrix": pose}]
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    bpy.ops.gsopt.import_cameras(directory=str(tmp_path))
    bpy.ops.gsopt.look_through()
    scene = bpy.context.scene
    bpy.context.view_layer.update()
    point = Vector((1.0, 1.3, 1.9))
    axes = [Vector(column) for column in zip(*[row[:3] for row in pose[:3]], strict=True)]
    x, y, z = (axis.dot(point - Vector((4, 1, 2))) for axis in axes)
    expected = (90 + 120 * x / -z) / 200, 1 - (60 - 120 * y / -z) / 100
    seen = world_to_camera_view(scene, scene.camera, point)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (200, 100)
    assert tuple(seen)[:2] == pytest.approx(expected, abs=1e-4)


def test_prompts_stay_in_the_blend_and_in_the_file(panel: Any, tmp_path: Path) -> None:
    import bpy

    made = {"source": "llm:qwen", "raw": "raw.txt"}
    prompts = [
        {"text": "春", "weight": 0.5, "view": "back", "polarity": "negative", "source": "llm:qwen", "score": 0.25}
    ]
    (tmp_path / "a.json").write_text(json.dumps({"version": 1, "made": made, "prompts": prompts}))
    bpy.ops.gsopt.prompts_read(filepath=str(tmp_path / "a.json"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.gsopt.prompts_write(filepath=str(tmp_path / "b.json"))
    written = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))
    assert written == {"version": 1, "made": made, "prompts": [{**prompts[0], "rationale": ""}]}


def test_proposals_are_taken_one_by_one(panel: Any) -> None:
    import bpy

    for text in ("one", "two", "three", "four"):
        panel.proposals.add().text = text
    bpy.ops.gsopt.proposal(accept=True)
    bpy.ops.gsopt.proposal(accept=False)
    panel.proposals[0].text = "three, edited"
    bpy.ops.gsopt.proposal(accept=True, all=True)
    assert [entry.text for entry in panel.prompts] == ["one", "three, edited", "four"]
    fails_with("no proposal", bpy.ops.gsopt.proposal)


def test_faults_end_in_a_message(panel: Any, tmp_path: Path) -> None:
    import bpy

    write_ply(tmp_path / "a.ply", random_splats(5, 0))
    (tmp_path / "lies.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"vertex 5", b"vertex 999"))
    settings = bpy.context.preferences.addons["blender_addon"].preferences
    fails_with("claims 999 rows", bpy.ops.gsopt.import_splats, filepath=str(tmp_path / "lies.ply"))
    fails_with("neither .ply nor .spz", bpy.ops.gsopt.import_splats, filepath=str(tmp_path / "a.obj"))
    fails_with("holds no splats yet", bpy.ops.gsopt.import_splats, filepath=str(tmp_path))
    fails_with("holds no run", bpy.ops.gsopt.attach, directory=str(tmp_path))
    fails_with("Nothing to render", bpy.ops.gsopt.render_dataset)
    fails_with("no dataset", bpy.ops.gsopt.launch)
    fails_with("No run is going on", bpy.ops.gsopt.stop)
    fails_with("notes are empty", bpy.ops.gsopt.propose)
    fails_with("No splats are named", bpy.ops.gsopt.import_splats)
    settings.interpreter = str(tmp_path / "no python")
    fails_with("not there or not a program", bpy.ops.gsopt.test)
    wrong = tmp_path / "wrong python"
    wrong.write_text("#!/bin/sh\necho 'No module named gsopt'; exit 1\n")
    wrong.chmod(0o755)
    settings.interpreter = str(wrong)
    fails_with("No module named gsopt", bpy.ops.gsopt.test)
    other = {"gsopt": "9.1", "rasterizer": {"isa": "x", "backend": "x", "ms_per_step": 1, "problem": None}}
    wrong.write_text(f"#!/bin/sh\necho '{json.dumps(other)}'\n")
    fails_with("gsopt 9.1, this extension knows", bpy.ops.gsopt.test)


def event(kind: str, **fields: Any) -> str:
    return json.dumps({"v": 1, "seq": 0, "kind": kind, "time": 1.8e9, **fields}) + "\n"


@pytest.mark.parametrize(
    ("log", "status", "said"),
    [
        (event("started", pid=2**22 + 1, total=9, step=0), "killed", "Resume"),
        (
            event("started", pid=1, total=9) + event("error", message="The disk is full. Free some space."),
            "error",
            "disk",
        ),
        (event("started", pid=1, total=9).replace('"v": 1', '"v": 7'), "unreadable", "protocol version 7"),
        ("garbage\n" * 10 + event("done", step=9), "done", ""),
        (event("done", step=9) + '{"v": 1, "seq": 3, "ki', "done", ""),
    ],
)
def test_whatever_a_run_left_behind_is_told(panel: Any, tmp_path: Path, log: str, status: str, said: str) -> None:
    import bpy

    run = tmp_path / "run"
    run.mkdir()
    (run / "events.jsonl").write_text(log)
    bpy.ops.gsopt.attach(directory=str(run))
    bpy.ops.gsopt.follow(seconds=20.0)
    assert panel.run_status == status
    assert said in panel.run_message


def test_a_program_that_dies_at_once_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    (tmp_path / "data").mkdir()
    panel.dataset, panel.source = str(tmp_path / "data"), "DATASET"
    wrong = tmp_path / "python"
    wrong.write_text("#!/bin/sh\necho 'gsopt: There is no scene in it. Give another.'; exit 3\n")
    wrong.chmod(0o755)
    bpy.context.preferences.addons["blender_addon"].preferences.interpreter = str(wrong)
    fails_with("There is no scene in it", bpy.ops.gsopt.launch)
    assert panel.run_status == "error"


def test_live_previews_replace_each_other_in_short_ticks(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon import watching

    run = tmp_path / "run"
    (run / "previews").mkdir(parents=True)
    events = event("started", pid=1, total=9, step=0)
    for step in (1, 2):
        write_ply(run / "previews" / f"step_{step}.ply", random_splats(1000 * step))
        (run / "events.jsonl").write_text(
            events := events + event("preview", step=step, path=f"previews/step_{step}.ply")
        )
        bpy.ops.gsopt.attach(directory=str(run))
        assert watching.wait(lambda: panel.run_preview != "" and not watching._loads, 30)
    (live,) = (o for o in bpy.data.objects if o.get("gsopt_live"))
    assert len(live.data.vertices) == 2000
    assert len([mesh for mesh in bpy.data.meshes if mesh.get("gsopt_splats")]) == 1, "the old preview is gone"


def test_enabling_and_disabling_leaves_nothing_behind(panel: Any) -> None:
    import bpy

    import blender_addon
    from blender_addon import registration, watching

    for _ in range(2):
        blender_addon.unregister()
        assert not hasattr(bpy.types.Scene, "gsopt")
        assert not hasattr(bpy.types.Object, "gsopt")
        assert registration.after_load not in bpy.app.handlers.load_post
        assert not bpy.app.timers.is_registered(watching.tick)
        assert not [name for name in dir(bpy.types) if name.startswith("GSOPT_")]
        blender_addon.register()
