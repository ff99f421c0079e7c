"""One object from mesh to dataset: a pure function of (mesh, settings, seed) that any scheduler can call."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsopt.errors import InputError, MissingDependency, UsageError
from gsopt.farm.job import PARTIAL
from synth import captions, lighting_and_render, pixels
from synth.cameras import Shot, shots
from synth.export import export, write_json
from synth.exr import read_passes
from synth.import_mesh import ImportedMesh, import_mesh
from synth.mesh_items import Item
from synth.points import SurfacePoints
from synth.settings import SPLITS, Settings

if TYPE_CHECKING:
    from jaxtyping import Float32, UInt8

RECORD = "object.json"
NOTHING = 1e9
"""Blender's depth where no surface is seen lies above this."""


@dataclass
class Timing:
    """Seconds of the wall clock."""

    stage: float = 0.0
    """Reading and mending the mesh."""
    render: float = 0.0
    """Inside Blender's render operator."""
    write: float = 0.0
    """Decoding passes, encoding and writing files."""


@dataclass
class Views:
    """Data gathered while the views of an object are rendered."""

    points: SurfacePoints | None
    colors: list[dict[str, int]] = field(default_factory=list)
    pictures: dict[str, list[UInt8[np.ndarray, "H W 3"]]] = field(default_factory=dict)
    opaque: int = 0
    """Pixels of all views that show something."""


def require_blender() -> None:
    """MissingDependency, with the line that installs it, unless `bpy` is there; does not load it."""
    if "bpy" not in sys.modules and find_spec("bpy") is None:
        raise MissingDependency(
            "synth_views needs Blender. Install its module with `pip install bpy` (4.2 to 5.0 want Python 3.11, "
            "5.1 and 5.2 want 3.13), or run `blender -b -P scripts/synth_views.py -- ...`."
        )


def load_bpy() -> Any:
    """Blender's Python module. MissingDependency without Blender, UsageError inside a Blender with windows."""
    require_blender()
    import bpy

    if not bpy.app.background:
        raise UsageError(
            "Rendering an object here would replace the open Blender file. Call `synth.render_dataset.run`, which "
            "starts Blender in the background."
        )
    return bpy


def render_object(mesh: Path, settings: Settings, seed: int, out: Path, item: Item | None = None) -> Timing:
    """Render `mesh` into the new folder `out`, which appears complete or not at all, with its record in object.json.

    The same mesh, settings and seed give the same files on the same version of Blender; `item` adds what is known
    about the object. InputError when the mesh cannot be rendered or `out` exists; MissingDependency without Blender.
    """
    item = item or Item(mesh.stem, mesh)
    bpy = load_bpy()
    timing = Timing()
    with new_folder(out) as folder:
        with clocked(timing, "stage"):
            imported = import_mesh(bpy, mesh, settings.normalize)
            lighting_and_render.light(bpy, settings)
            lighting_and_render.set_up_renderer(bpy, settings)
            views = shots(settings, seed)
        gathered = render_views(bpy, settings, views, seed, imported, folder, timing)
        with clocked(timing, "write"):
            if not gathered.opaque:
                raise InputError(f"Every view of {mesh} is empty: its materials are transparent. Repair them.")
            record = describe(
                mesh, item, views, seed, imported, gathered, lighting_and_render.renderer_name(bpy, settings)
            )
            cloud = gathered.points.found() if gathered.points else None
            origin = {"normalized_from_mesh": record["normalized_from_mesh"], "id": item.id}
            export(folder, settings, views, cloud, origin)
            if settings.captions:
                sentences = {v.name: captions.view_caption(record["caption"], v, item.front) for v in views}
                write_json(folder / "captions.json", {"caption": record["caption"], "views": sentences})
            if settings.preview:
                sheet = pixels.contact_sheet([np.stack(row) for row in gathered.pictures.values()])
                (folder / "preview.png").write_bytes(pixels.png(sheet))
            record["points"] = 0 if cloud is None else len(cloud[0])
            write_json(folder / RECORD, record | {"files_sha256": digest_of_files(folder)})
    return timing


def render_views(
    bpy: Any,
    settings: Settings,
    views: Sequence[Shot],
    seed: int,
    imported: ImportedMesh,
    folder: Path,
    timing: Timing,
) -> Views:
    """Render every view and write its files; view i draws its noise from `seed + i`."""
    camera = lighting_and_render.add_camera(bpy)
    points = SurfacePoints(imported.triangles, settings.points, seed) if settings.points else None
    gathered = Views(points)
    with tempfile.TemporaryDirectory(prefix="synth_views_") as scratch:
        for number, view in enumerate(views):
            with clocked(timing, "render"):
                lighting_and_render.aim(camera, view, settings.resolution)
                lighting_and_render.photograph(bpy, seed + number, Path(scratch) / "view.exr")
            with clocked(timing, "write"):
                keep_view(settings, view, read_passes(Path(scratch) / "view.exr"), folder, gathered)
    return gathered


def keep_view(
    settings: Settings, view: Shot, passes: dict[str, Float32[np.ndarray, "H W C"]], folder: Path, gathered: Views
) -> None:
    """Write the files of one view, and gather what the object as a whole needs."""
    rgba = pixels.straight_rgba(passes["color"])
    background = settings.background_rgb
    image = rgba if background is None else pixels.over(rgba, background)
    save_png(folder / "images" / f"{view.name}.png", image)
    gathered.opaque += int((rgba[..., 3] > 127).sum())
    show = gathered.pictures if settings.preview else {}
    show.setdefault("image", []).append(pixels.over(rgba, background or pixels.BACKDROP))
    if settings.captions and view.split == "train":
        gathered.colors.append(captions.count_colors(rgba))
    if not settings.needs_depth:
        return
    depth = np.where(passes["depth"] < NOTHING, passes["depth"], 0.0)[..., 0].astype(np.float32)
    hard = depth > 0
    if gathered.points and view.split == "train":
        gathered.points.see(view, rgba, depth)
    if settings.depth:
        save_npy(folder / "depth" / f"{view.name}.npy", depth)
        show.setdefault("depth", []).append(pixels.depth_picture(depth))
    if settings.normals:
        unit = passes["normals"] / np.maximum(np.linalg.norm(passes["normals"], axis=2, keepdims=True), 1e-9)
        normals = np.where(hard[..., None], unit, 0.0).astype(np.float16)
        save_npy(folder / "normal" / f"{view.name}.npy", normals)
        show.setdefault("normals", []).append(pixels.normal_picture(normals, hard))
    if settings.position:
        save_npy(folder / "position" / f"{view.name}.npy", np.where(hard[..., None], passes["position"], np.float32(0)))
    if settings.masks:
        mask = np.where(hard, 255, 0).astype(np.uint8)
        save_png(folder / "mask" / f"{view.name}.png", mask)
        save_png(folder / "alpha" / f"{view.name}.png", rgba[..., 3])
        show.setdefault("masks", []).append(np.repeat(mask[..., None], 3, axis=2))


def save_png(path: Path, picture: UInt8[np.ndarray, "H W *C"]) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(pixels.png(picture))


def save_npy(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    np.save(path, values)


def describe(
    mesh: Path,
    item: Item,
    views: Sequence[Shot],
    seed: int,
    imported: ImportedMesh,
    gathered: Views,
    renderer: str,
) -> dict[str, Any]:
    """The record of an object: what it is, how it was rendered, and how to undo the normalization."""
    caption = captions.object_caption(item, captions.total_colors(gathered.colors))
    return item.known() | {
        "caption": caption,
        "mesh": mesh.name,
        "mesh_bytes": mesh.stat().st_size,
        "mesh_sha256": hashlib.sha256(mesh.read_bytes()).hexdigest(),
        "triangles": len(imported.triangles),
        "normalized_from_mesh": imported.normalized_from_mesh.tolist(),
        "views": {split: sum(view.split == split for view in views) for split in SPLITS},
        "seed": seed,
        "renderer": renderer,
        "warnings": imported.warnings,
    }


def digest_of_files(folder: Path) -> str:
    """sha256 over the names and bytes of all files in name order."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A temporary sibling of `out` that becomes `out` when the block succeeds and is removed when it fails.

    InputError when `out` exists already or cannot be made; nothing that exists is touched.
    """
    if os.path.lexists(out):
        raise InputError(f"The output folder must be new, but {out} exists. Remove it or choose another.")
    partial = out.parent / f"{PARTIAL}{os.getpid()}-{out.name}"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial.mkdir()
    except OSError as error:
        raise InputError(f"Cannot make the output folder {out}: {error.strerror}. Choose another.") from None
    try:
        yield partial
        partial.rename(out)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextmanager
def clocked(timing: Timing, name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    setattr(timing, name, getattr(timing, name) + time.perf_counter() - began)
