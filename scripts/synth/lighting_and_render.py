"""Lights, lens and renderer: everything about the picture but the object."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.errors import GsoptError, InputError
from synth.cameras import Shot, look_at_origin
from synth.import_mesh import load_image, matrix_rows
from synth.settings import Settings

# Position and side of the square (units of the unit sphere), power (W): key, fill, back, and a weak one from below.
# A matte surface that faces one of power P from distance d has the radiance albedo * P / (pi * d)².
LAMPS = (
    ((-3.0, -3.5, 4.0), 3.0, 190.0),
    ((4.0, -2.0, 2.0), 4.0, 90.0),
    ((0.5, 4.5, 3.0), 4.0, 120.0),
    ((0.0, 0.0, -4.0), 4.0, 30.0),
)
STUDIO_RADIANCE = 0.35
SHINE = ("Metallic", "Specular IOR Level", "Transmission Weight", "Subsurface Weight", "Coat Weight", "Sheen Weight")


def light(bpy: Any, settings: Settings) -> None:
    """The same light for every view: it stands in the world, and no camera sees it."""
    if settings.lighting == "studio":
        add_world(bpy, STUDIO_RADIANCE)
        add_lamps(bpy)
    elif settings.lighting == "hdri":
        add_environment(bpy, Path(str(settings.hdri)), add_world(bpy, 1.0))
    else:
        add_world(bpy, 1.0)  # for shaders other than Principled
        for material in [m for m in bpy.data.materials if m.node_tree]:
            flatten(material.node_tree)


def add_world(bpy: Any, radiance: float) -> Any:
    """Even white light from all around; returns its node tree."""
    world = bpy.context.scene.world = bpy.data.worlds.new("world")
    if world.node_tree is None:  # before Blender 5
        world.use_nodes = True
    shader = world.node_tree.nodes["Background"]
    shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    shader.inputs["Strength"].default_value = radiance
    return world.node_tree


def add_lamps(bpy: Any) -> None:
    """Soft area lights."""
    for number, (position, size, power) in enumerate(LAMPS):
        lamp = bpy.data.lights.new(f"area {number}", "AREA")
        lamp.size, lamp.energy = size, power
        lit = bpy.data.objects.new(lamp.name, lamp)
        bpy.context.scene.collection.objects.link(lit)
        lit.matrix_world = matrix_rows(look_at_origin(np.array([position]))[0])
        lit.visible_camera = False


def add_environment(bpy: Any, file: Path, tree: Any) -> None:
    """An equirectangular image all around. InputError when it is no image."""
    image = load_image(bpy, file)
    if image is None:
        raise InputError(f"`--lighting hdri` cannot read {file}. Give an equirectangular .hdr, .exr, .png or .jpg.")
    node = tree.nodes.new("ShaderNodeTexEnvironment")
    node.image = image
    tree.links.new(node.outputs["Color"], tree.nodes["Background"].inputs["Color"])


def flatten(tree: Any) -> None:
    """Let every Principled shader emit its base color and reflect nothing."""
    for node in [n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"]:
        base, glow = node.inputs["Base Color"], node.inputs["Emission Color"]
        for link in list(base.links):
            tree.links.new(link.from_socket, glow)
            tree.links.remove(link)
        if not glow.is_linked:
            glow.default_value = base.default_value
        base.default_value = (0.0, 0.0, 0.0, 1.0)
        for name, value in (("Emission Strength", 1.0), *((name, 0.0) for name in SHINE)):
            for link in list(node.inputs[name].links):
                tree.links.remove(link)
            node.inputs[name].default_value = value


def add_camera(bpy: Any) -> Any:
    """The scene's camera; field of view and shift count along the width, whatever the aspect."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit = "HORIZONTAL"
    lens.clip_start = 1e-3
    camera = bpy.data.objects.new("camera", lens)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def aim(camera: Any, shot: Shot, size: tuple[int, int]) -> None:
    """Pose and lens of one view. Blender's shift is a share of the width and moves the frame, not the picture."""
    width, height = size
    camera.matrix_world = matrix_rows(shot.world_from_cam)
    camera.data.angle = 2.0 * math.atan(0.5 * width / shot.focal)
    camera.data.shift_x = (0.5 * width - shot.center[0]) / width
    camera.data.shift_y = (shot.center[1] - 0.5 * height) / width
    camera.data.clip_end = 10.0 * (float(np.linalg.norm(shot.eye)) + 1.0)


def set_up_renderer(bpy: Any, settings: Settings) -> None:
    """Transparent film, the passes asked for, no denoiser and no film look, into one uncompressed float EXR.

    The EXR holds scene-linear light, so no view transform of Blender's touches the colors: `pixels` codes them.
    """
    scene = bpy.context.scene
    render = scene.render
    render.engine = {"cycles": "CYCLES", "workbench": "BLENDER_WORKBENCH"}[settings.engine]
    render.threads_mode, render.threads = ("FIXED" if settings.threads else "AUTO"), max(settings.threads, 1)
    render.use_persistent_data = render.film_transparent = True
    render.resolution_x, render.resolution_y = settings.resolution
    render.resolution_percentage = 100
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", settings.samples
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces, cycles.transparent_max_bounces = (0 if settings.lighting == "flat" else 4), 128
    shading = scene.display.shading
    shading.light, shading.color_type = "FLAT", "TEXTURE"
    scene.display.render_aa = "16"
    layer = scene.view_layers[0]
    layer.use_pass_z, layer.use_pass_normal = settings.needs_depth, settings.normals
    layer.use_pass_position = settings.position
    image = render.image_settings
    if hasattr(image, "media_type"):  # Blender 5
        image.media_type, image.use_exr_interleave = "MULTI_LAYER_IMAGE", True
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"


def photograph(bpy: Any, seed: int, path: Path) -> None:
    """Render into `path` (.exr), with the noise that belongs to `seed`."""
    scene = bpy.context.scene
    scene.cycles.seed = seed % (1 << 31)
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    if not path.is_file():
        raise GsoptError(f"Blender wrote no image at {path}. Check the free space on the disk.")


def renderer_name(bpy: Any, settings: Settings) -> str:
    return f"Blender {bpy.app.version_string} {settings.engine}"
