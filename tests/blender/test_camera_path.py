"""Camera animations leave the panel as paths of `gsopt render` and come back as the same animations."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_panel import fails_with

from blender_addon.core.camera_path import CameraPath, read_path, write_path
from blender_addon.core.errors import InputError

POSE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1]


def document() -> dict[str, Any]:
    entry = {"camera_to_world": POSE, "fov": 50.0}
    return {"render_width": 8, "render_height": 6, "fps": 24, "camera_path": [entry]}


def run_folder(folder: Path) -> Path:
    """A run of a dataset far from the origin, half a meter to the unit."""
    run = folder / "run"
    run.mkdir()
    (run / "config.json").write_text(json.dumps({"origin": [1000.0, -2000.0, 5.0]}))
    (run / "units.json").write_text('{"meters_per_unit": 0.5}')
    return run


def film(first: float, last: float) -> Any:
    """A camera that moves along x over four frames, turns and zooms."""
    import bpy

    scene = bpy.context.scene
    camera = bpy.data.objects.new("film", bpy.data.cameras.new("film"))
    scene.collection.objects.link(camera)
    scene.camera, scene.frame_start, scene.frame_end = camera, 3, 6
    scene.render.resolution_x, scene.render.resolution_y = 300, 200
    for at, x in ((3, first), (6, last)):
        camera.location, camera.rotation_euler, camera.data.lens = (x, -4, 1), (1.2, 0.1, x / 3), 40 + x
        camera.keyframe_insert("location", frame=at)
        camera.keyframe_insert("rotation_euler", frame=at)
        camera.data.keyframe_insert("lens", frame=at)
    return camera


def placed(frame: int) -> tuple[np.ndarray, float]:
    """World matrix and vertical field of view of the scene's camera at a frame."""
    import bpy

    scene = bpy.context.scene
    scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    return np.array(scene.camera.evaluated_get(graph).matrix_world), scene.camera.calc_matrix_camera(
        graph, x=300, y=200
    )[1][1]


@pytest.mark.parametrize("up", ["MINUS_Y", "DATASET"])
def test_an_animation_comes_back_as_the_same_animation(panel: Any, tmp_path: Path, up: str) -> None:
    import bpy

    panel.run_path, panel.up = str(run_folder(tmp_path)), up
    film(-1.0, 2.0)
    bpy.context.scene.frame_set(5)
    bpy.ops.gsopt.export_camera_path(filepath=str(tmp_path / "path.json"))
    assert bpy.context.scene.frame_current == 5
    before = [placed(frame) for frame in range(3, 7)]
    bpy.ops.gsopt.import_camera_path(filepath=str(tmp_path / "path.json"))
    assert bpy.context.scene.camera.name == "path"
    for frame, (matrix, zoom) in zip(range(3, 7), before, strict=True):
        found, found_zoom = placed(frame)
        np.testing.assert_allclose(found, matrix, atol=2e-4)  # float32 beside an origin of 2000
        assert found_zoom == pytest.approx(zoom, rel=1e-5)


def test_gsopt_sees_what_blender_sees(panel: Any, tmp_path: Path) -> None:
    """A point of the scene falls on the same pixel of Blender's camera and of the camera that gsopt reads."""
    torch = pytest.importorskip("torch")
    import bpy
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    from gsopt.results.camera_path_file import read_camera_path

    panel.run_path, panel.up = str(run_folder(tmp_path)), "MINUS_Y"
    film(-1.0, 2.0)
    bpy.ops.gsopt.export_camera_path(filepath=str(tmp_path / "path.json"))
    cameras = read_camera_path(tmp_path / "path.json", (1000.0, -2000.0, 5.0))
    assert [len(cameras), cameras[0].width, cameras[0].height] == [4, 300, 200]
    for row, point in enumerate([(0.0, 0.3, 0.1), (0.2, 0.0, -0.4), (0.1, 0.2, 0.3), (-0.2, 0.1, 0.5)]):
        bpy.context.scene.frame_set(3 + row)
        seen = world_to_camera_view(bpy.context.scene, bpy.context.scene.camera, Vector(point))
        x, y, z = point  # of the panel: z up, meters; the splats: -y up, half a meter to the unit
        splat = torch.tensor([x, -z, y, 0.5]) / 0.5
        ray = cameras[row].Ks[0] @ (cameras[row].viewmats[0] @ splat)[:3]
        pixel = (ray[:2] / ray[2]).tolist()
        assert pixel == pytest.approx([300 * seen.x, 200 * (1 - seen.y)], abs=0.1)


def test_a_path_keeps_its_own_time(panel: Any, tmp_path: Path) -> None:
    """12 cameras per second in a scene of 24: every second frame."""
    import bpy

    pose = np.eye(4)
    shots = [(pose + np.eye(4, k=3) * x, math.radians(50)) for x in range(3)]
    write_path(tmp_path / "p.json", CameraPath(shots, 300, 200, 12.0))
    bpy.context.scene.frame_start, bpy.context.scene.frame_end, panel.up = 1, 2, "DATASET"
    bpy.ops.gsopt.import_camera_path(filepath=str(tmp_path / "p.json"))
    assert bpy.context.scene.frame_end == 5
    assert [round(placed(frame)[0][0, 3], 4) for frame in (1, 3, 5)] == [0, 1, 2]


def test_what_cannot_be_a_path_is_told(panel: Any, tmp_path: Path) -> None:
    import bpy

    fails_with("no perspective camera", bpy.ops.gsopt.export_camera_path, filepath=str(tmp_path / "a.json"))
    film(0.0, 1.0).data.type = "ORTHO"
    fails_with("no perspective camera", bpy.ops.gsopt.export_camera_path, filepath=str(tmp_path / "a.json"))
    fails_with("Cannot read", bpy.ops.gsopt.import_camera_path, filepath=str(tmp_path / "a.json"))
    (tmp_path / "mine.json").write_text("mine")
    bpy.context.scene.camera.data.type = "PERSP"
    fails_with("exists already", bpy.ops.gsopt.export_camera_path, filepath=str(tmp_path / "mine"))
    assert (tmp_path / "mine.json").read_text() == "mine"


@pytest.mark.parametrize(
    "change",
    [
        {"render_width": 0},
        {"render_height": 1e9},
        {"fps": 0},
        {"fps": "24"},
        {"camera_path": []},
        {"camera_path": 3},
        {"camera_path": [3]},
        {"camera_path": [{"fov": 50}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [1] * 16}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [float("nan")] * 16}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [10**400] * 16}]},
        {"camera_path": [{"fov": 180, "camera_to_world": POSE}]},
        {"camera_path": [{"fov": [], "camera_to_world": POSE}]},
    ],
)
def test_a_broken_path_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    (tmp_path / "p.json").write_text(json.dumps(document()))
    assert len(read_path(tmp_path / "p.json").shots) == 1
    (tmp_path / "p.json").write_text(json.dumps(document() | change))
    with pytest.raises(InputError, match=r"p\.json"):
        read_path(tmp_path / "p.json")
