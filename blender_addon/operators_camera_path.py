"""4 Inspect: the animation of the scene's camera as a camera path of `gsopt render`, and such a path as animation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from .core.camera_path import MOST_SHOTS, CameraPath, read_path, write_path
from .core.errors import InputError, UsageError
from .core.files import read_json
from .core.units import meters_per_unit
from .operator_errors import ReportingOperator
from .operators_inspect import data_of, frame, refuse_to_replace
from .preferences import absolute

SUFFIX = ".json"


def scene_from_dataset(settings: Any) -> Matrix:
    """From the frame of the attached run's dataset to the scene's; that of the splats without a run."""
    if not settings.run_path:
        return frame(settings, None)
    run = absolute(settings.run_path)
    return frame(settings, data_of(run), meters_per_unit(run)) @ Matrix.Translation([-x for x in origin_of(run)])


def origin_of(run: Path) -> list[float]:
    """The point that gsopt subtracts from the positions of a georeferenced dataset."""
    try:
        origin = [float(x) for x in read_json(run / "config.json").get("origin") or ()]
    except (InputError, TypeError, ValueError):
        return [0.0] * 3
    return origin if len(origin) == 3 and all(map(math.isfinite, origin)) else [0.0] * 3


class GSOPT_OT_export_camera_path(ReportingOperator, bpy.types.Operator):
    """Write the animation of the scene's camera, frame by frame, for `gsopt render --path` and nerfstudio"""

    bl_idname = "gsopt.export_camera_path"
    bl_label = "Export Camera Path"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        self.filepath = self.filepath or "camera-path.json"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        scene = context.scene
        camera, frames = scene.camera, range(scene.frame_start, scene.frame_end + 1)
        if camera is None or camera.data.type != "PERSP":
            raise UsageError("The scene has no perspective camera. Add one, or make it the active camera.")
        if len(frames) > MOST_SHOTS:
            raise UsageError(f"The scene has {len(frames)} frames, a path at most {MOST_SHOTS}. Shorten its range.")
        path = absolute(self.filepath)
        if path.suffix.lower() != SUFFIX:
            path = path.with_name(f"{path.name}{SUFFIX}")
            refuse_to_replace(path)
        width, height = size_of(scene)
        back = scene_from_dataset(scene.gsopt).inverted()
        shots = list(filmed(context, back, frames))
        write_path(path, CameraPath(shots, width, height, scene.render.fps / scene.render.fps_base))
        lost = "; its lens shift is left out" if camera.data.shift_x or camera.data.shift_y else ""
        return f"{len(shots)} cameras in {path}{lost}"


def size_of(scene: Any) -> tuple[int, int]:
    """The size of a render, px."""
    render = scene.render
    width, height = (
        max(1, side * render.resolution_percentage // 100) for side in (render.resolution_x, render.resolution_y)
    )
    return width, height


def filmed(context: Any, back: Matrix, frames: range) -> Iterator[tuple[np.ndarray, float]]:
    """The camera of each frame in the frame of the dataset, and its vertical field of view; the frame stays."""
    scene, before = context.scene, context.scene.frame_current_final
    width, height = size_of(scene)
    try:
        for number in frames:
            scene.frame_set(number)
            camera, graph = scene.camera, context.evaluated_depsgraph_get()
            place, turn, _ = (back @ camera.evaluated_get(graph).matrix_world).decompose()
            aspect = {"scale_x": scene.render.pixel_aspect_x, "scale_y": scene.render.pixel_aspect_y}
            lens = camera.calc_matrix_camera(graph, x=width, y=height, **aspect)
            yield np.array(Matrix.Translation(place) @ turn.to_matrix().to_4x4()), 2 * math.atan(1 / lens[1][1])
    finally:
        scene.frame_set(math.floor(before), subframe=before - math.floor(before))


class GSOPT_OT_import_camera_path(ReportingOperator, bpy.types.Operator):
    """Bring in a path of gsopt's viewer, of `gsopt render` or of nerfstudio as an animated camera"""

    bl_idname = "gsopt.import_camera_path"
    bl_label = "Import Camera Path"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        scene, file = context.scene, absolute(self.filepath)
        path = read_path(file)
        scene.camera = animated(scene, path, file.stem)
        scene.render.resolution_x, scene.render.resolution_y = path.width, path.height
        scene.render.resolution_percentage = 100
        last = scene.frame_start + (len(path.shots) - 1) * rate(scene) / path.fps
        scene.frame_end = max(scene.frame_end, math.ceil(last - 1e-3))
        return f"{len(path.shots)} cameras from {file.name}"


def rate(scene: Any) -> float:
    """Frames per second of the scene."""
    return float(scene.render.fps / scene.render.fps_base)


def animated(scene: Any, path: CameraPath, name: str) -> Any:
    """A camera with a key for each of the path's, at the path's own times from the first frame on."""
    lens = bpy.data.cameras.new(name)
    lens.sensor_fit = "VERTICAL"
    camera = bpy.data.objects.new(name, lens)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    matrix, before = scene_from_dataset(scene.gsopt), None
    scale = matrix.to_scale().x
    lens.clip_start, lens.clip_end = 0.01 * scale, 1000 * scale
    for row, (pose, fov) in enumerate(path.shots):
        place, turn, _ = (matrix @ Matrix(pose.tolist())).decompose()
        if before is not None and turn.dot(before) < 0:
            turn.negate()
        at = scene.frame_start + row * rate(scene) / path.fps
        camera.location, camera.rotation_quaternion, lens.angle_y = place, turn, fov
        camera.keyframe_insert("location", frame=at)
        camera.keyframe_insert("rotation_quaternion", frame=at)
        lens.keyframe_insert("lens", frame=at)
        before = turn
    return camera


CLASSES = (GSOPT_OT_export_camera_path, GSOPT_OT_import_camera_path)
