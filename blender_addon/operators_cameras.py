"""4 Inspect: bring the cameras of a dataset in and look through them."""

from __future__ import annotations

from typing import Any

import bpy
from mathutils import Matrix

from . import splat_object
from .core.cameras import View, read_views
from .core.errors import UsageError
from .core.units import meters_per_unit
from .operator_errors import ReportingOperator
from .operators_inspect import data_of, frame
from .preferences import absolute

MAX_CAMERAS = 200


class GSOPT_OT_import_cameras(ReportingOperator, bpy.types.Operator):
    """Import the dataset's cameras with their pictures as backgrounds"""

    bl_idname = "gsopt.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    directory: bpy.props.StringProperty(subtype="DIR_PATH")  # type: ignore[valid-type]

    def do(self, context: Any) -> str:
        settings = context.scene.gsopt
        data = absolute(self.directory) if self.directory else None
        if data is None and settings.run_path:
            data = data_of(absolute(settings.run_path))
        if data is None and settings.dataset:
            data = absolute(settings.dataset)
        if data is None:
            raise UsageError("No dataset is known. Choose one, or attach to a run.")
        views = read_views(data)
        home = bpy.data.collections.new("gsopt cameras")
        context.scene.collection.children.link(home)
        scale = meters_per_unit(absolute(settings.run_path)) if settings.run_path else 1.0
        matrix = frame(settings, data, scale)
        for view in views[:MAX_CAMERAS]:
            add_camera(home, view, matrix, settings.picture)
        return f"{min(len(views), MAX_CAMERAS)} of {len(views)} cameras"


def add_camera(home: Any, view: View, matrix: Matrix, alpha: float) -> Any:
    """A camera object with its picture. The frame may scale the scene; a camera has a place and a direction only."""
    name = f"{view.split} {view.name}"
    lens = bpy.data.cameras.new(name)
    lens.sensor_fit = "HORIZONTAL"
    lens.angle = view.angle_x
    lens.shift_x, lens.shift_y = view.shift
    place, turn, scale = (matrix @ Matrix(view.world_from_cam.tolist())).decompose()
    lens.display_size = 0.1 * scale.x
    lens.clip_start, lens.clip_end = 0.01 * scale.x, 1000 * scale.x
    camera = bpy.data.objects.new(name, lens)
    camera.matrix_world = Matrix.Translation(place) @ turn.to_matrix().to_4x4()
    camera["gsopt_size"] = [view.width, view.height]
    home.objects.link(camera)
    if view.image.is_file():
        picture = lens.background_images.new()
        picture.image = bpy.data.images.load(str(view.image), check_existing=True)
        picture.alpha, picture.display_depth = alpha, "FRONT"
        lens.show_background_images = True
    return camera


class GSOPT_OT_look_through(ReportingOperator, bpy.types.Operator):
    """Look through this input camera: its picture lies over the splats, the render has its size"""

    bl_idname = "gsopt.look_through"
    bl_label = "Look Through"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    camera: bpy.props.StringProperty(options={"SKIP_SAVE"})  # type: ignore[valid-type]
    step: bpy.props.IntProperty(default=0, options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def do(self, context: Any) -> str:
        scene = context.scene
        cameras = [o for o in scene.objects if o.type == "CAMERA" and "gsopt_size" in o]
        named = scene.objects.get(self.camera) if self.camera else None
        if not cameras or (self.camera and named not in cameras):
            raise UsageError("There is no input camera of that name. Import the cameras first.")
        at = cameras.index(scene.camera) + self.step if scene.camera in cameras else 0
        camera = named or cameras[at % len(cameras)]
        scene.camera = camera
        width, height = picture_size(camera)
        if width and height:
            scene.render.resolution_x, scene.render.resolution_y = width, height
            scene.render.resolution_percentage = 100
            set_pixel_filter(scene, splat_object.pixel_filter(camera.data.angle, width))
        for picture in camera.data.background_images:
            picture.alpha = scene.gsopt.picture
        for area in [a for w in context.window_manager.windows for a in w.screen.areas if a.type == "VIEW_3D"]:
            area.spaces.active.region_3d.view_perspective = "CAMERA"
        return camera.name


def picture_size(camera: Any) -> tuple[int, int]:
    """Size of the input image, px."""
    width, height = camera["gsopt_size"]
    pictures = [p.image for p in camera.data.background_images if p.image]
    return (width, height) if width and height else tuple(pictures[0].size) if pictures else (0, 0)


def set_pixel_filter(scene: Any, value: float) -> None:
    for thing in scene.objects:
        modifier = splat_object.modifier_of(thing) if splat_object.is_splats(thing) else None
        if modifier is not None:
            splat_object.set_input(modifier, "Pixel Filter", value)


CLASSES = (GSOPT_OT_import_cameras, GSOPT_OT_look_through)
