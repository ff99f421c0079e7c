"""Poses from a few photos of a thing on a table in a room, where the cameras are known exactly.

    python experiments/table_photos.py MESHES OUT --render                   # needs bpy; 15 s a photo
    python experiments/table_photos.py MESHES OUT --arm NAME [--counts 12 6 4] [--only lantern ...]

MESHES/NAME/*.obj are meshes of which none belongs to `test`. Each scene has 12 photos of 800x600 px by a hand-held
camera of 27 mm, without EXIF, exposure and height vary; the walls carry pictures, the same ones several times in some
scenes: there a photo can match the wrong wall. ARM names the rows in experiments/results/table_photos.json.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsopt.benchmark.machine import machine
from gsopt.data.scene import read_dataset
from gsopt.data.sfm.trajectory import compare
from gsopt.events import to_json, write_atomic

RESULTS = Path(__file__).parent / "results" / "table_photos.json"
PHOTOS, SIZE, LENS, SENSOR = 12, (800, 600), 27.0, 36.0
JPEG_QUALITY = 93
TWICE = ("chair/wood", "plaidChair/cloth-texture-19", "vase3/ABSTRACT", "wood_logs/wood_logs_texture")
"""Pictures on the walls, drawn by lot: the same one hangs on several of them."""
REST = ("fountain/white-marble", "captains-bed/woodtexture", "bowlWithSalad/textureWoodBowl", "armchair2/armchair_tex")
ONCE = (*TWICE, *REST)
"""Two for each wall."""


@dataclass(frozen=True)
class TableScene:
    """Things on a table, its picture (None: it is plain), and the degrees that the camera goes round."""

    things: tuple[str, ...]
    table: str | None
    degrees: float
    pictures: tuple[str, ...]


SCENES = {
    "rabbit_wood": TableScene(("rabbit",), "bedWithTexture/wood10", 360, TWICE),
    "chair_cloth": TableScene(("chair", "cup"), "plaidChair/cloth-texture-19", 360, TWICE),
    "bulldog_plain": TableScene(("bulldog",), None, 360, TWICE),
    "lantern_wood": TableScene(("lantern",), "kitchenChair/Wood_plancks_003_COLOR", 150, TWICE),
    "basketball_marble": TableScene(("basketball",), "fountain/white-marble", 150, TWICE),
    "vase3_wood": TableScene(("vase3", "cup"), "captains-bed/woodtexture", 360, TWICE),
    "rabbit2": TableScene(("rabbit",), "bedWithTexture/wood10", 360, ONCE),
    "bulldog2": TableScene(("bulldog",), None, 360, ONCE),
    "vase2": TableScene(("vase3", "cup"), "captains-bed/woodtexture", 360, ONCE),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--render", action="store_true")
    parser.add_argument("--arm", default="")
    parser.add_argument("--counts", type=int, nargs="*", default=[12, 6, 4])
    parser.add_argument("--only", nargs="*", default=list(SCENES), choices=SCENES)
    parser.add_argument("--flags", nargs=argparse.REMAINDER, default=[], help="further words for `gsopt sfm`; last")
    options = parser.parse_args()
    if options.render:
        for name in options.only:
            render(name, SCENES[name], options.meshes, options.out / name)
    for count in options.counts if options.arm else []:
        for name in options.only:
            key, rows = f"{options.arm} {name} {count}", read()
            if key not in rows:
                row = measured(options.out / name, count, options.flags)
                print(key, json.dumps(row), flush=True)
                write_atomic(RESULTS, to_json({"machine": machine(), "rows": {**read(), key: row}}))


def read() -> dict[str, Any]:
    return dict(json.loads(RESULTS.read_text())["rows"]) if RESULTS.is_file() else {}


def measured(scene: Path, count: int, flags: list[str]) -> dict[str, Any]:
    """One call of `gsopt sfm` with so many of the photos, evenly spread, against the exact cameras."""
    cameras = json.loads((scene / "cameras.json").read_text())
    with tempfile.TemporaryDirectory() as temporary:
        photos, posed = Path(temporary, "photos"), Path(temporary, "posed")
        photos.mkdir()
        for number in (i * PHOTOS // count for i in range(count)):
            with Image.open(scene / f"{number:02d}.png", formats=("PNG",)) as image:
                image.convert("RGB").save(photos / f"{number:02d}.jpg", quality=JPEG_QUALITY)
        command = [sys.executable, "-m", "gsopt", "sfm", str(photos), "-o", str(posed), "--threads", "1", *flags]
        began = time.perf_counter()
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        row: dict[str, Any] = {"photos": count, "seconds": round(time.perf_counter() - began)}
        if ended.returncode != 0:
            return {**row, "posed": 0, "said": ended.stderr.strip().splitlines()}
        record = json.loads((posed / "sfm.json").read_text())
        found = {Path(frame.name).stem: frame for frame in read_dataset(posed).frames}
    names = sorted(found)
    viewmats = [np.stack([found[name].viewmat.numpy() for name in names]), np.array([cameras[name] for name in names])]
    row |= {"posed": len(names), "points": record["points"], "mapper": record["mapper"]}
    row["focal_ratio"] = round(float(found[names[0]].K[0, 0]) / (SIZE[0] * LENS / SENSOR), 4)
    return {**row, "error_px": round(record["reprojection_error"], 2), **compare(*viewmats).summary()}


def render(name: str, scene: TableScene, meshes: Path, out: Path) -> None:
    """Writes the photos and cameras.json, cam_from_world in OpenCV axes by photo."""
    import bpy
    from mathutils import Matrix, Vector

    lot = random.Random(name)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for number, thing in enumerate(scene.things):
        stand(bpy, next((meshes / thing).glob("*.obj")), 0.12 if number else 0.3, (0.22 * number, 0.05 * number))
    room(bpy, scene, meshes, lot)
    camera = settings(bpy)
    out.mkdir(parents=True, exist_ok=True)
    cameras: dict[str, Any] = {}
    for number in range(PHOTOS):
        turn = math.radians(scene.degrees * number / PHOTOS + lot.uniform(-4, 4))
        up, far = math.radians(lot.uniform(18, 38)), lot.uniform(0.6, 0.8)
        across = far * math.cos(up)
        eye = Vector((across * math.cos(turn), across * math.sin(turn), 0.12 + far * math.sin(up)))
        target = Vector([lot.uniform(-0.03, 0.03), lot.uniform(-0.03, 0.03), 0.12 + lot.uniform(-0.03, 0.03)])
        axes = (target - eye).to_track_quat("-Z", "Y").to_matrix().to_4x4()
        camera.matrix_world = Matrix.Translation(eye) @ axes @ Matrix.Rotation(math.radians(lot.uniform(-4, 4)), 4, "Z")
        bpy.context.scene.view_settings.exposure = lot.uniform(-0.2, 0.2)
        bpy.context.scene.render.filepath = str(out / f"{number:02d}.png")
        bpy.ops.render.render(write_still=True)
        world_from_cam = np.array(camera.matrix_world) @ np.diag([1, -1, -1, 1])
        cameras[f"{number:02d}"] = np.linalg.inv(world_from_cam).tolist()
    write_atomic(out / "cameras.json", to_json(cameras))


def stand(bpy: Any, mesh: Path, size: float, where: tuple[float, float]) -> None:
    """Stands a mesh on the table, meters."""
    from mathutils import Matrix, Vector

    before = set(bpy.data.objects)
    bpy.ops.wm.obj_import(filepath=str(mesh), up_axis="Y", forward_axis="NEGATIVE_Z")
    shapes = [shape for shape in bpy.data.objects if shape not in before and shape.type == "MESH"]
    bpy.context.view_layer.update()
    corners = np.array([shape.matrix_world @ Vector(corner) for shape in shapes for corner in shape.bound_box])
    low, high = corners.min(0), corners.max(0)
    middle = (low + high) / 2
    placed = Matrix.Translation((*where, 0)) @ Matrix.Scale(size / float((high - low).max()), 4)
    placed = placed @ Matrix.Translation((-middle[0], -middle[1], -low[2]))
    for shape in shapes:
        if shape.parent not in shapes:
            shape.matrix_world = placed @ shape.matrix_world


def room(bpy: Any, scene: TableScene, meshes: Path, lot: random.Random) -> None:
    """The table, the floor, four walls with two pictures each, and the light."""
    table = None if scene.table is None else meshes / f"{scene.table}.jpg"
    plane(bpy, 1.4, (0, 0, -0.002), (0, 0, 0), table, (0.8, 0.8, 0.78))
    plane(bpy, 8, (0, 0, -0.8), (0, 0, 0), None, (0.35, 0.3, 0.25))
    for wall in range(4):
        turn = wall * math.pi / 2
        cos, sin = math.cos(turn), math.sin(turn)
        upright = (math.pi / 2, 0, turn + math.pi / 2)
        plane(bpy, 8, (3 * cos, 3 * sin, 1), upright, None, (0.6 + 0.1 * (wall % 2), 0.6, 0.55))
        for side in range(2):
            shown = lot.choice(TWICE) if scene.pictures is TWICE else scene.pictures[2 * wall + side]
            path = next(meshes.glob(f"{shown}.*[gG]"))
            shift = 2 * side - 1
            spot = (2.97 * cos - shift * sin, 2.97 * sin + shift * cos, 0.6 + 0.2 * side)
            plane(bpy, 0.8, spot, upright, path, (1, 1, 1))
    bpy.ops.object.light_add(type="AREA", location=(1.2, -0.8, 2.2))
    light = bpy.context.object
    light.data.energy, light.data.size, light.rotation_euler = 45, 0.8, (0.5, 0.4, 0)
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world, world.use_nodes = world, True
    sky = world.node_tree.nodes["Background"].inputs
    sky[0].default_value, sky[1].default_value = (0.7, 0.75, 0.8, 1), 0.5


def plane(bpy: Any, size: float, spot: Any, turned: Any, picture: Path | None, color: tuple[float, ...]) -> None:
    """A square, with a picture or in one color."""
    bpy.ops.mesh.primitive_plane_add(size=size, location=spot, rotation=turned)
    material = bpy.data.materials.new("plane")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = nodes["Principled BSDF"].inputs
    surface["Roughness"].default_value, surface["Base Color"].default_value = 0.6, (*color, 1)
    if picture is not None:
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = bpy.data.images.load(str(picture))
        links.new(texture.outputs[0], surface["Base Color"])
    bpy.context.object.data.materials.append(material)


def settings(bpy: Any) -> Any:
    """A camera, and Cycles as fast as features allow."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.sensor_width, camera.data.lens = SENSOR, LENS
    scene = bpy.context.scene
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 5, True
    scene.cycles.max_bounces = 4
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.view_settings.view_transform, scene.render.image_settings.file_format = "Standard", "PNG"
    return camera


if __name__ == "__main__":
    main()
