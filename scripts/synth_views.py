"""Render a posed RGBA dataset (NeRF-synthetic layout) from one mesh, with Blender's Cycles on the CPU.

Either with the `bpy` wheel (`pip install bpy`) or inside Blender 4.2 or newer:

    python scripts/synth_views.py chair.glb --out data/chair --views 24 --test-views 12
    blender -b -P scripts/synth_views.py -- chair.glb --out data/chair --views 24 --test-views 12

The mesh is moved into the unit sphere; `normalized_from_mesh` in the json maps the file's coordinates to the world's.
`render_object` is the whole of it; this file and synth_layout.py can be imported without bpy.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

# Blender's own Python knows neither this folder nor the project; the script runs from a checkout.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from synth_layout import (
    Layout,
    RenderSettings,
    camera_directions,
    frame_names,
    look_at_origin,
    normalization,
    transforms,
)

from gsopt import check
from gsopt.errors import GsoptError, InputError, MissingDependency

if TYPE_CHECKING:
    from jaxtyping import Float

MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl")
Y_UP = (".obj", ".glb", ".gltf")
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
MAX_MESH_BYTES = 2 << 30


def check_mesh(mesh: Path) -> None:
    """InputError unless `mesh` is a non-empty file of a kind that Blender reads here."""
    kinds = ", ".join(MESH_SUFFIXES)
    if not mesh.is_file():
        raise InputError(f"There is no mesh at {mesh}. Give a file of these kinds: {kinds}.")
    if mesh.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"A mesh must be one of {kinds}; got {mesh.name}. Convert it first.")
    size = mesh.stat().st_size
    if not 0 < size <= MAX_MESH_BYTES:
        raise InputError(f"{mesh} must hold 1 to {MAX_MESH_BYTES} bytes, got {size}. Export or decimate it again.")
    if mesh.suffix.lower() == ".ply":
        check_ply_counts(mesh, size)


def check_ply_counts(mesh: Path, size: int) -> None:
    """InputError when a PLY header announces more elements than the file has bytes: Blender would crash on it."""
    with mesh.open("rb") as file:
        header = file.read(1 << 16).split(b"end_header")[0]
    for words in [line.split() for line in header.splitlines()]:
        if len(words) == 3 and words[0] == b"element" and not (words[2].isdigit() and int(words[2][:20]) <= size):
            name, count = (w[:20].decode("ascii", "replace") for w in words[1:])
            raise InputError(f"{mesh} announces {count} of {name}, more than its {size} bytes hold. Export it again.")


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A temporary sibling of `out` that becomes `out` when the block succeeds and is removed when it fails.

    InputError when `out` exists already or cannot be made; nothing that exists is touched.
    """
    if os.path.lexists(out):
        raise InputError(f"The output folder must be new, but {out} exists. Remove it or choose another `--out`.")
    partial = out.parent / f".{out.name}.{os.getpid()}.partial"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial.mkdir()
    except OSError as error:
        raise InputError(f"Cannot make the output folder {out}: {error.strerror}. Choose another `--out`.") from None
    try:
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    try:
        partial.rename(out)
    except OSError as error:
        raise InputError(
            f"Cannot rename {partial} to {out}: {error.strerror}. The images are safe in the former."
        ) from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


# Blender


def load_bpy() -> Any:
    """Blender's Python module, or MissingDependency with the line that installs it."""
    try:
        import bpy
    except ImportError:
        raise MissingDependency(
            "synth_views needs Blender. Install its module with `pip install bpy` (4.2 to 5.0 want Python 3.11), "
            "or run `blender -b -P scripts/synth_views.py -- ...`."
        ) from None
    return bpy


def import_mesh(bpy: Any, mesh: Path) -> Float[np.ndarray, "4 4"]:
    """Fill an empty scene with the mesh, normalise it, return normalized_from_mesh. InputError when it is unusable."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    suffix = mesh.suffix.lower()
    importers = {".obj": bpy.ops.wm.obj_import, ".ply": bpy.ops.wm.ply_import, ".stl": bpy.ops.wm.stl_import}
    try:
        importers.get(suffix, bpy.ops.import_scene.gltf)(filepath=str(mesh.resolve()))
    except Exception as error:  # importers in C++ raise RuntimeError, the one in Python whatever it stumbled over
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        raise InputError(f"Blender cannot read {mesh}: {reason[0]} Export it again or convert it.") from None
    lost = sorted({image.filepath or image.name for image in bpy.data.images if image.size[0] == 0})
    if lost:
        raise InputError(f"{mesh.name} names textures that cannot be read: {', '.join(lost[:5])}. Put them beside it.")
    for other in [o for o in bpy.data.objects if o.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(other)
    matrix = normalization(surface_vertices(bpy, mesh))
    roots = [o for o in bpy.data.objects if o.parent is None]
    anchor = bpy.data.objects.new("normalized_from_imported", None)
    for root in roots:
        root.parent = anchor
    bpy.context.scene.collection.objects.link(anchor)
    anchor.matrix_world = matrix_rows(matrix)
    return matrix @ Z_UP_FROM_Y_UP if suffix in Y_UP else matrix


def surface_vertices(bpy: Any, mesh: Path) -> Float[np.ndarray, "V 3"]:
    """World positions of all vertices that a face uses; bare meshes get a material. InputError without any face."""
    graph = bpy.context.evaluated_depsgraph_get()
    found = []
    for source in [o for o in bpy.context.view_layer.objects if o.type == "MESH" and o.visible_get()]:
        if not any(source.data.materials):
            source.data.materials.append(plain_material(bpy, source.data))
        shape = source.evaluated_get(graph)
        data = shape.to_mesh()
        positions = np.empty((len(data.vertices), 3), np.float32)
        data.vertices.foreach_get("co", positions.ravel())
        corners = np.empty(len(data.loops), np.int32)
        data.loops.foreach_get("vertex_index", corners)
        world = np.array(shape.matrix_world, np.float64)
        found.append(positions[np.unique(corners)] @ world[:3, :3].T + world[:3, 3])
        shape.to_mesh_clear()
    vertices = np.concatenate(found) if found else np.empty((0, 3))
    if not len(vertices):
        raise InputError(f"{mesh} holds no faces to render. Export the surface, not only points, lines or empties.")
    return vertices


def plain_material(bpy: Any, data: Any) -> Any:
    """A matte material that shows the mesh's vertex colours where it has some, else light grey."""
    material = bpy.data.materials.new("plain")
    if material.node_tree is None:  # before Blender 5
        material.use_nodes = True
    nodes = material.node_tree.nodes
    surface = nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (0.6, 0.6, 0.6, 1.0)
    surface.inputs["Roughness"].default_value = 0.9
    if len(data.color_attributes):
        colors = nodes.new("ShaderNodeVertexColor")
        colors.layer_name = data.color_attributes[0].name
        material.node_tree.links.new(colors.outputs["Color"], surface.inputs["Base Color"])
    return material


# Position and side of the square (units of the unit sphere), power (W): key, fill, back, and a weak one from below.
# A matte surface that faces one of power P from distance d has the radiance albedo * P / (pi * d)².
LIGHTS = (
    ((-3.0, -3.5, 4.0), 3.0, 190.0),
    ((4.0, -2.0, 2.0), 4.0, 90.0),
    ((0.5, 4.5, 3.0), 4.0, 120.0),
    ((0.0, 0.0, -4.0), 4.0, 30.0),
)
WORLD_RADIANCE = 0.35


def add_lights(bpy: Any) -> None:
    """Soft area lights, fixed in the world and unseen by the camera, and an even light from all around."""
    scene = bpy.context.scene
    for number, (position, size, power) in enumerate(LIGHTS):
        lamp = bpy.data.lights.new(f"area {number}", "AREA")
        lamp.size, lamp.energy = size, power
        lit = bpy.data.objects.new(lamp.name, lamp)
        scene.collection.objects.link(lit)
        lit.matrix_world = matrix_rows(look_at_origin(np.array([position]))[0])
        lit.visible_camera = False
    scene.world = bpy.data.worlds.new("studio")
    if scene.world.node_tree is None:  # before Blender 5
        scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = WORLD_RADIANCE


def matrix_rows(matrix: Float[np.ndarray, "4 4"]) -> Any:
    """A matrix as bpy properties take it: a mathutils.Matrix, since a plain list is read column by column."""
    from mathutils import Matrix

    return Matrix(matrix.tolist())


def add_camera(bpy: Any, settings: RenderSettings) -> Any:
    """The scene's camera: `fov_x` across the width, whatever the aspect."""
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit = "HORIZONTAL"
    lens.angle = settings.fov_x
    lens.clip_start, lens.clip_end = 1e-3, 10.0 * settings.distance
    camera = bpy.data.objects.new("camera", lens)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def configure_render(bpy: Any, settings: RenderSettings) -> None:
    """Cycles on the CPU, no denoiser, transparent film, sRGB without a film look, bare 8-bit RGBA PNG."""
    scene = bpy.context.scene
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    cycles.device, cycles.samples = "CPU", settings.samples
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces, cycles.transparent_max_bounces = 4, 32
    render.threads_mode, render.threads = ("FIXED" if settings.threads else "AUTO"), max(settings.threads, 1)
    render.use_persistent_data = render.film_transparent = True
    render.resolution_x = render.resolution_y = settings.resolution
    render.resolution_percentage = 100
    render.dither_intensity = 0.0
    scene.view_settings.view_transform = "Standard"
    image = render.image_settings
    image.file_format, image.color_mode, image.color_depth, image.compression = "PNG", "RGBA", "8", 100


def drop_metadata(path: Path) -> None:
    """Rewrite a PNG with its pixels only: Cycles notes its render times in it, and so no two files were alike."""
    content, kept, at = path.read_bytes(), [b"\x89PNG\r\n\x1a\n"], 8
    while at < len(content):
        end = at + 12 + int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : at + 8] in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(content[at:end])
        at = end
    path.write_bytes(b"".join(kept))


def render_views(
    bpy: Any, camera: Any, poses: Float[np.ndarray, "N 4 4"], names: list[str], out: Path, seed: int
) -> None:
    """One PNG per pose at `out / name`; view i draws its noise from `seed + i`."""
    scene = bpy.context.scene
    for number, (pose, name) in enumerate(zip(poses, names, strict=True)):
        began = time.perf_counter()
        path = (out / name).with_suffix(".png")
        camera.matrix_world = matrix_rows(pose)
        scene.cycles.seed = (seed + number) % (1 << 31)
        scene.render.filepath = str(path.resolve())
        bpy.ops.render.render(write_still=True)
        if not path.is_file() or path.stat().st_size == 0:
            raise GsoptError(f"Blender wrote no image at {path}. Check the free space on the disk.")
        drop_metadata(path)
        print(f"{name} ({number + 1} of {len(names)}): {time.perf_counter() - began:.2f} s", flush=True)


def render_object(mesh: Path, settings: RenderSettings, seed: int, out: Path) -> None:
    """Render `mesh` into the new NeRF-synthetic dataset `out`: transforms_{train,test}.json and their images.

    The folder appears complete or not at all. InputError when the mesh is missing, unreadable or empty or when `out`
    exists; MissingDependency without Blender.
    """
    check_mesh(mesh)
    bpy = load_bpy()
    with new_folder(out) as folder:
        normalized_from_mesh = import_mesh(bpy, mesh)
        add_lights(bpy)
        camera = add_camera(bpy, settings)
        configure_render(bpy, settings)
        origin = {
            "normalized_from_mesh": normalized_from_mesh.tolist(),
            "mesh": mesh.name,
            "mesh_sha256": hashlib.sha256(mesh.read_bytes()).hexdigest(),
            "seed": seed,
            "settings": {k: v for k, v in dataclasses.asdict(settings).items() if k != "threads"},
            "renderer": f"Blender {bpy.app.version_string} Cycles CPU",
        }
        for split, directions in zip(("train", "test"), camera_directions(settings, seed), strict=True):
            if not len(directions):
                continue
            poses = look_at_origin(settings.distance * directions)
            (folder / split).mkdir()
            names = frame_names(split, len(poses))
            render_views(bpy, camera, poses, names, folder, seed if split == "train" else seed + settings.views)
            write_json(folder / f"transforms_{split}.json", transforms(split, poses, settings) | origin)


def own_arguments(argv: list[str]) -> list[str]:
    """What was meant for this script: all after `--` inside Blender, all after the script's name otherwise."""
    if "--" in argv:
        return argv[argv.index("--") + 1 :]
    return argv[1:] if argv and argv[0].endswith(".py") else []


def parse(arguments: list[str]) -> tuple[Path, RenderSettings, int, Path]:
    """Mesh, settings, seed and output folder from the command line."""
    default = RenderSettings()
    parser = argparse.ArgumentParser(prog="synth_views.py", description="Render a NeRF-synthetic dataset from a mesh.")
    parser.add_argument("mesh", type=Path, help="OBJ, GLB, GLTF, PLY or STL file")
    parser.add_argument("--out", type=Path, required=True, help="dataset folder to make; must not exist")
    parser.add_argument("--views", type=int, default=default.views, help="input views")
    parser.add_argument("--test-views", type=int, default=default.test_views, help="held-out views")
    parser.add_argument("--resolution", type=int, default=default.resolution, help="side of the square images, px")
    parser.add_argument("--samples", type=int, default=default.samples, help="light paths per pixel")
    parser.add_argument("--fov", type=float, default=default.fov, help="field of view, degrees")
    parser.add_argument("--radius", type=float, help="camera distance; the object fits the unit sphere")
    parser.add_argument("--layout", choices=get_args(Layout), default=default.layout, help="where the cameras stand")
    parser.add_argument(
        "--elevations", type=float, nargs=2, metavar=("LOW", "HIGH"), help="degrees; own of each layout"
    )
    parser.add_argument("--seed", type=int, default=0, help="turns the cameras about z and seeds the noise")
    parser.add_argument("--threads", type=int, default=default.threads, help="of Cycles; 0 = every core")
    given = vars(parser.parse_args(arguments))
    mesh, seed, out = given.pop("mesh"), given.pop("seed"), given.pop("out")
    check.at_least("--seed", seed, 0, "Any whole number from 0 on will do.")
    given["elevations"] = tuple(given["elevations"]) if given["elevations"] else None
    return mesh, RenderSettings(**given), seed, out


def main(argv: list[str]) -> int:
    try:
        render_object(*parse(own_arguments(argv)))
    except GsoptError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
