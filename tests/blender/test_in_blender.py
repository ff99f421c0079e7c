"""Splats in Blender: what comes in goes out the same, each display shows it, filters hide what they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_panel import bring_in, event, fails_with
from made_splats import random_splats

from blender_addon.core.ply import read_ply, write_ply

SHOWN = {"Points": 0, "Spheres": 0, "Ellipsoids": 100, "Gaussians": 100}


def test_what_comes_in_goes_out_the_same(panel: Any, odd_folder: Path) -> None:
    import bpy

    bring_in(odd_folder / "a b.ply")
    bpy.ops.gsopt.export(filepath=str(odd_folder / "out.ply"))
    before, after = read_ply(odd_folder / "a b.ply"), read_ply(odd_folder / "out.ply")
    for name in ("positions", "scales", "rotations", "opacities", "base", "sh"):
        assert np.allclose(getattr(before, name), getattr(after, name), rtol=1e-5, atol=1e-6), name


def test_an_export_has_the_name_that_was_given_and_replaces_nothing_unasked(panel: Any, tmp_path: Path) -> None:
    """A dot in a name begins no suffix; the dialog asks about the file it was given, and about no other."""
    import bpy

    bring_in(tmp_path / "a.ply")
    (tmp_path / "chair.ply").write_bytes(b"mine")
    assert bpy.ops.gsopt.export.get_rna_type().properties["check_existing"].default
    bpy.ops.gsopt.export(filepath=str(tmp_path / "chair.v2"))
    assert len(read_ply(tmp_path / "chair.v2.ply").positions)
    assert (tmp_path / "chair.ply").read_bytes() == b"mine"
    fails_with("exists already", bpy.ops.gsopt.export, filepath=str(tmp_path / "chair"))
    assert (tmp_path / "chair.ply").read_bytes() == b"mine"


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


def test_live_previews_replace_each_other_in_short_ticks(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon import progress_timer

    run = tmp_path / "run"
    (run / "previews").mkdir(parents=True)
    events = event("started", pid=1, total=9, step=0)
    for step in (1, 2):
        write_ply(run / "previews" / f"step_{step}.ply", random_splats(1000 * step))
        (run / "events.jsonl").write_text(
            events := events + event("preview", step=step, path=f"previews/step_{step}.ply")
        )
        bpy.ops.gsopt.attach(directory=str(run))
        assert progress_timer.wait(lambda: panel.run_preview != "" and not progress_timer._loads, 30)
    (live,) = (o for o in bpy.data.objects if o.get("gsopt_live"))
    assert len(live.data.vertices) == 2000
    assert len([mesh for mesh in bpy.data.meshes if mesh.get("gsopt_splats")]) == 1, "the old preview is gone"


def test_enabling_and_disabling_leaves_nothing_behind(panel: Any) -> None:
    import bpy

    import blender_addon
    from blender_addon import progress_timer, registration

    for _ in range(2):
        blender_addon.unregister()
        assert not hasattr(bpy.types.Scene, "gsopt")
        assert not hasattr(bpy.types.Object, "gsopt")
        assert registration.after_load not in bpy.app.handlers.load_post
        assert not bpy.app.timers.is_registered(progress_timer.tick)
        assert not [name for name in dir(bpy.types) if name.startswith("GSOPT_")]
        blender_addon.register()


def test_an_edited_export_has_the_picture_of_what_was_kept(panel: Any, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    import bpy
    from mathutils import Matrix

    import gsopt
    from gsopt.geometry.cameras import look_at

    thing = bring_in(tmp_path / "a.ply")
    thing.matrix_world = Matrix.Rotation(0.7, 4, "X") @ Matrix.Scale(3.0, 4)
    panel.least_opacity = 0.4
    bpy.ops.gsopt.filter()
    bpy.ops.gsopt.delete_hidden()
    bpy.ops.gsopt.export(filepath=str(tmp_path / "b.ply"))
    before, after = (gsopt.load_splats(tmp_path / name) for name in ("a.ply", "b.ply"))
    kept = before.opacities >= 0.4
    eyes = torch.tensor([[0.0, 1.0, -6.0]])
    lens = torch.tensor([[[40.0, 0.0, 24.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]]])
    cameras = gsopt.Cameras(look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), lens, 48, 48)
    pictures = [gsopt.rasterize(splats, cameras).colors for splats in (before.select(kept), after)]
    assert pictures[0].max() > 0.2
    assert torch.allclose(*pictures, atol=1e-5)


def test_each_scene_gets_what_it_asked_for(panel: Any, tmp_path: Path) -> None:
    import bpy

    from blender_addon import progress_timer

    write_ply(tmp_path / "a.ply", random_splats(10))
    write_ply(tmp_path / "b.ply", random_splats(20))
    scenes = [bpy.context.scene, bpy.data.scenes.new("other")]
    for scene, name in zip(scenes, ("a.ply", "b.ply"), strict=True):
        with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
            bpy.ops.gsopt.import_splats(filepath=str(tmp_path / name), wait=False)
    scenes[1].name = "renamed meanwhile"
    assert progress_timer.wait(lambda: not progress_timer._loads, 30)
    assert [scene.gsopt.job_import.state for scene in scenes] == ["DONE", "DONE"]
    assert [[len(o.data.vertices) for o in scene.objects] for scene in scenes] == [[10], [20]]


def test_an_undo_does_not_lose_a_run(panel: Any) -> None:
    """Undo brings back the scene's properties of an earlier time; a run has gone on since."""
    from blender_addon import registration

    panel.run_status, panel.run_path, panel.run_step, panel.job_poses.state = "running", "/runs/a", 40, "RUNNING"
    registration.before_undo()
    panel.run_status, panel.run_path, panel.run_step, panel.job_poses.state = "", "", 0, "NONE"
    registration.after_undo()
    now = panel.run_status, panel.run_path, panel.run_step, panel.job_poses.state
    assert now == ("running", "/runs/a", 40, "RUNNING")
