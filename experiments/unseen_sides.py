"""Measures what shape and colors of unseen sides are worth, with one to three photos of an object.

    python experiments/unseen_sides.py SCENES... [-o FILE.json] [--views 1 2 3] [--seeds 2]

SCENES are posed scenes of objects with alpha and held-out views, or folders of them; a seed is a choice of photos, as
in few_photos.py. No run is made: bodies of voxels are drawn in the held-out views, and the table has their mean PSNR.
A body has the shape that gsopt believes without symmetries (one photo: inflated, or the library's; else the rounded
hull), or the true one, the hull of all views. Where no photo shows its surface it takes the photos' colors straight
through the body (what gsopt does), those of the nearest point that a photo shows, or the true ones.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from few_photos import photos, scenes
from jaxtyping import Float
from torch import Tensor

from gsopt.benchmark.machine import machine
from gsopt.config.train import DataConfig
from gsopt.data.scene import Scene, View, load_scene
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus
from gsopt.geometry.voxels import Grid
from gsopt.init.guessed_views import drawn_voxels
from gsopt.init.hull import carve
from gsopt.init.inflation import inflated
from gsopt.init.rounded_hull import rounded
from gsopt.init.surface_colors import seen_colors
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.metrics import psnr
from gsopt.raster.api import make_backend
from gsopt.shape_library.completion import completion
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary

RESULT = Path(__file__).parent / "results" / "unseen_sides.json"
CHUNK = 2000


def hull(views: tuple[View, ...], extent: float) -> tuple[Grid, list[Thumbnail]]:
    """Returns the hull of the views, and their small photos."""
    small = small_photos(views, len(views))
    grid = carve(small, find_focus([photo.camera for photo in small], extent))
    assert grid is not None
    return grid, small


def believed(scene: Scene) -> Iterator[tuple[str, Grid]]:
    """The shapes that gsopt believes from the input views alone."""
    grid, small = hull(scene.train, scene.extent)
    if len(small) > 1:
        yield "rounded hull", replace(grid, occupied=rounded(grid.occupied, grid.centers(), grid.voxel, small))
        return
    if (rule := inflated(small[0], scene.extent)) is not None:
        yield "inflated", rule
    if (found := completion(small[0], scene.extent, ShapeLibrary(BUNDLED), [])) is not None:
        yield "library", found.body


def nearest(grid: Grid, points: Float[Tensor, "N 3"], rgb: Float[Tensor, "N 3"]) -> Float[Tensor, "X Y Z 3"]:
    """Every surface voxel in the color of the nearest of the points."""
    colors, surface = torch.zeros(*grid.occupied.shape, 3), grid.surface()
    rows = torch.cat([torch.cdist(part, points).argmin(1) for part in surface.split(CHUNK)])
    colors[tuple(((surface - grid.low) / grid.voxel).long().T)] = rgb[rows]
    return colors


def painted(grid: Grid, small: list[Thumbnail], truth: tuple[Grid, list[Thumbnail]]) -> dict[str, Tensor | None]:
    """Colors of the voxels that no photo shows."""
    ways: dict[str, Tensor | None] = {"through": None}
    for name, shape, shown in (("nearest", grid, small), ("true", *truth)):
        points = shape.surface()
        rgb, seen = seen_colors(shape, shown, points)
        ways[name] = nearest(grid, points[seen], rgb[seen]) if bool(seen.any()) else None
    return ways


def measured(path: Path, views: int, seed: int) -> Iterator[dict[str, Any]]:
    """A record per shape and way of painting."""
    whole = load_scene(DataConfig(path=str(path)))
    scene = replace(whole, train=tuple(whole.train[row] for row in photos(path, views, seed)))
    small = small_photos(scene.train, views)
    truth = hull(whole.train + whole.test, whole.extent)
    backend, cameras = make_backend("cpu", 1), Cameras.cat([view.camera for view in scene.test])
    images = over_white(torch.stack([view.pixels() for view in scene.test]))
    for shape, grid in (*believed(scene), ("true", truth[0])):
        for colors, unseen in painted(grid, small, truth).items():
            drawn = over_white(drawn_voxels(grid, small, cameras, backend, unseen))
            value = sum(float(psnr(a[None], b[None])) for a, b in zip(drawn, images, strict=True)) / len(images)
            record = {"scene": path.name, "views": views, "seed": seed, "shape": shape, "colors": colors}
            yield {**record, "psnr": round(value, 4)}


def over_white(pixels: Tensor) -> Float[Tensor, "C H W 3"]:
    values = pixels.float() / 255
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]


def table(runs: list[dict[str, Any]]) -> str:
    """Mean PSNR over objects and seeds, dB."""
    ways = ("through", "nearest", "true")
    lines = ["| photos | shape | " + " | ".join(f"colors: {way}" for way in ways) + " |", "|---" * 5 + "|"]
    for views, shape in dict.fromkeys((one["views"], one["shape"]) for one in runs):
        cells = []
        for way in ways:
            found = [r["psnr"] for r in runs if (r["views"], r["shape"], r["colors"]) == (views, shape, way)]
            cells.append(f"{sum(found) / len(found):.2f}")
        lines.append(f"| {views} | {shape} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--seeds", type=int, default=2)
    options = parser.parse_args()
    document = json.loads(options.o.read_text()) if options.o.exists() else {"runs": []}
    known = {(one["scene"], one["views"], one["seed"]) for one in document["runs"]}
    for views, seed in ((views, seed) for views in options.views for seed in range(options.seeds)):
        for scene in scenes(options.scenes):
            if (scene.name, views, seed) not in known:
                document["runs"] += measured(scene, views, seed)
                write_atomic(options.o, to_json({**document, "machine": machine()}))
    print(table(document["runs"]))


if __name__ == "__main__":
    main()
