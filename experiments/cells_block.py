"""Makes a block: meshes on a ground plane, photographed from a grid of cameras above that each see a part of it.

    python experiments/cells_block.py MESHES SPLITS.json OUT [--meshes 30] [--cameras 60] [--pixels 200] [--samples 16]

OUT/data/block is a dataset as scripts/synth_views.py writes it, with every seventh camera held out. The meshes are
MESHES/NAME/*.obj; those of `val` and `train` in SPLITS.json are taken, in this order, never those of `test`. Needs bpy.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsopt.geometry.cameras import look_at, opengl_from_viewmats

HERE = Path(__file__).resolve().parent
COLUMNS, FILLED = 6, 0.8
"""Meshes along one side, and the share of its place that each fills."""
HEIGHT, AHEAD = 0.32, 0.3
"""Cameras above the ground and ahead of what they look at, in units in which the block fills the unit sphere."""
FOV = 60.0
HELD_OUT = 7


def make_block(names: list[str], meshes: Path, file: Path) -> None:
    """A .blend with the meshes in rows on a ground of colored patches."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    for number, name in enumerate(names):
        before = set(bpy.data.objects)
        (path,) = sorted((meshes / name).glob("*.obj"))[:1]
        bpy.ops.wm.obj_import(filepath=str(path))
        place(bpy, [one for one in bpy.data.objects if one not in before], number)
    rows = math.ceil(len(names) / COLUMNS)
    ground(bpy, COLUMNS, rows, file.with_suffix(".png"))
    bpy.ops.wm.save_as_mainfile(filepath=str(file))


def place(bpy: Any, shapes: list[Any], number: int) -> None:
    """Sets a mesh on its place: one unit per mesh, standing on z = 0."""
    bpy.context.view_layer.update()
    corners = np.array([shape.matrix_world @ corner.co for shape in shapes for corner in shape.data.vertices])
    low, high = corners.min(0), corners.max(0)
    scale = FILLED / float((high - low).max())
    anchor = bpy.data.objects.new(f"place {number}", None)
    bpy.context.scene.collection.objects.link(anchor)
    for shape in shapes:
        shape.parent = anchor
    middle = 0.5 * (low + high)
    anchor.scale = (scale,) * 3
    spot = (number % COLUMNS + 0.5, number // COLUMNS + 0.5)
    anchor.location = (spot[0] - scale * middle[0], spot[1] - scale * middle[1], -scale * low[2])


def ground(bpy: Any, columns: int, rows: int, image: Path) -> None:
    """A textured plane under all of them."""
    random = np.random.default_rng(0)
    patches = random.uniform(0.25, 0.75, (16 * rows, 16 * columns, 1)) + random.uniform(-0.1, 0.1, (1, 1, 3))
    patches = np.concatenate([patches, np.ones((*patches.shape[:2], 1))], axis=2)
    patches = np.repeat(np.repeat(patches, 8, 0), 8, 1).astype(np.float32)
    picture = bpy.data.images.new("ground", patches.shape[1], patches.shape[0])
    picture.pixels.foreach_set(patches.ravel())
    picture.filepath_raw, picture.file_format = str(image), "PNG"
    picture.save()
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata([(0, 0, 0), (columns, 0, 0), (columns, rows, 0), (0, rows, 0)], [], [(0, 1, 2, 3)])
    mesh.uv_layers.new().data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1])
    material = bpy.data.materials.new("ground")
    material.use_nodes = True
    nodes = material.node_tree
    texture = nodes.nodes.new("ShaderNodeTexImage")
    texture.image = bpy.data.images.load(str(image))
    nodes.links.new(texture.outputs["Color"], nodes.nodes["Principled BSDF"].inputs["Base Color"])
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("ground", mesh))


def cameras(count: int, rows: int) -> dict[str, Any]:
    """Poses on a grid above the block, in four directions by turns, each 45 degrees down."""
    half = np.array([COLUMNS, rows]) / math.hypot(COLUMNS, rows)
    across = math.ceil(math.sqrt(count * half[0] / half[1]))
    along = math.ceil(count / across)
    frames = []
    for number in range(count):
        cell = np.array([(number % across + 0.5) / across, (number // across + 0.5) / along])
        turn = math.radians(45 + 90 * (number % 4) + 15 * (number % 3))
        target = (2 * cell - 1) * 0.9 * half
        eye = target - AHEAD * np.array([math.cos(turn), math.sin(turn)])
        eyes, targets = ([[*place, z]] for place, z in ((eye, HEIGHT), (target, 0.0)))
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        pose = opengl_from_viewmats(look_at(*(torch.tensor(p, dtype=torch.float64) for p in (eyes, targets)), up))[0]
        split = "test" if number % HELD_OUT == HELD_OUT // 2 else "train"
        frames.append({"transform_matrix": pose.tolist(), "split": split})
    return {"frames": frames}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("meshes_folder", "splits", "out"):
        parser.add_argument(name, type=Path)
    for name, value in (("meshes", 30), ("cameras", 60), ("pixels", 200), ("samples", 16)):
        parser.add_argument(f"--{name}", type=int, default=value)
    flags = parser.parse_args()
    splits = json.loads(flags.splits.read_text(encoding="utf-8"))
    names = [name for name in splits["val"] + splits["train"] if list((flags.meshes_folder / name).glob("*.obj"))]
    names = names[: flags.meshes]
    flags.out.mkdir(parents=True, exist_ok=True)
    block, poses = flags.out / "block.blend", flags.out / "cameras.json"
    make_block(names, flags.meshes_folder, block)
    poses.write_text(json.dumps(cameras(flags.cameras, math.ceil(len(names) / COLUMNS))), encoding="utf-8")
    words = [str(block), "-o", str(flags.out / "data"), "--layout", "file", "--cameras", str(poses), "--fov", str(FOV)]
    words += ["--resolution", str(flags.pixels), "--samples", str(flags.samples), "--background", "gray"]
    script = HERE.parent / "scripts/synth_views.py"
    subprocess.run([sys.executable, str(script), *words, "--points", "20000"], check=True)


if __name__ == "__main__":
    main()
