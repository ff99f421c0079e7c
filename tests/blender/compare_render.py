"""A run's splats drawn by Cycles from a held-out camera, beside gsopt's own picture. Not a test.

    python tests/blender/compare_render.py RUN DATASET VIEW OUT.png [Gaussians|Ellipsoids|Spheres]

RUN needs `gsopt eval`'s pictures in renders/test. Blends coded colors as gsopt does (view transform Raw) and prints the
mean difference over all pixels and over those of the object.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from mathutils import Matrix  # noqa: E402

from blender_addon import loading, splat_object  # noqa: E402
from blender_addon.core import statistics  # noqa: E402
from blender_addon.core.cameras import read_views  # noqa: E402
from blender_addon.material import let_cycles_see_through  # noqa: E402
from blender_addon.operators_cameras import add_camera  # noqa: E402


def pixels(path: Path) -> Any:
    """[H, W, 4] as stored, rows from the top."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def set_up(width: int, height: int) -> None:
    """One ray through the center of each pixel, coded values, no background."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 1, False, 0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    let_cycles_see_through(scene)
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage, scene.render.film_transparent = 100, True
    scene.view_settings.view_transform = "Raw"
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "16"


def main(run: Path, data: Path, number: int, out: Path, display: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    reference = pixels(sorted((run / "renders" / "test").glob("*.png"))[number])
    height, width = reference.shape[:2]
    splats = loading.read(run / "splat.ply")
    mesh = splat_object.make_mesh(bpy, "run", splats)
    size = float(np.median(statistics.sizes(splats)))
    home = bpy.context.scene.collection
    thing = splat_object.make_object(bpy, home, mesh, size, 10**7, display)
    view = [view for view in read_views(data) if view.split == "test"][number]
    bpy.context.scene.camera = add_camera(home, view, Matrix(), 0.0)
    modifier = splat_object.modifier_of(thing)
    splat_object.set_input(modifier, "Linear Color", False)
    splat_object.set_input(modifier, "Pixel Filter", splat_object.pixel_filter(view.angle_x, width))
    set_up(width, height)
    bpy.context.scene.render.filepath = str(out.absolute())
    began = time.process_time()
    bpy.ops.render.render(write_still=True)
    seconds = time.process_time() - began
    drawn = pixels(out)
    picture = drawn[..., :3] * drawn[..., 3:] + 1 - drawn[..., 3:]
    off = np.abs(picture - reference[..., :3])
    inside = (reference[..., :3] < 0.999).any(axis=2) | (drawn[..., 3] > 0)
    found = {"display": display, "mean": float(off.mean()), "mean inside": float(off[inside].mean())}
    print("found " + json.dumps(found | {"PSNR": float(-10 * np.log10((off**2).mean())), "cpu_s": round(seconds, 1)}))


if __name__ == "__main__":
    given = sys.argv[1:]
    shown = given[4] if len(given) > 4 else "Gaussians"
    main(Path(given[0]), Path(given[1]), int(given[2]), Path(given[3]), shown)
