"""Points on the surface of a mesh file, evenly spread, with their colors. z is up."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from gsopt._optional import require
from gsopt.errors import InputError

SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")
Y_UP = (".obj", ".glb", ".gltf")
MAX_BYTES = 256 << 20
MAX_TRIANGLES = 4_000_000
POINTS_PER_FACE = 6
"""Points on the area of a voxel's face: fewer leave holes that light would fall through."""
POINTS_PER_MESH = (20_000, 600_000)
"""Fewest and most."""
PLASTIC = (np.sqrt(5) - 1) / 2, 0.7548776662466927, 0.5698402909980532
"""Generators of the additive sequences that choose a triangle and a place on it (Roberts 2018)."""
MAX_TEXTURE_SIDE = 512
GRAY = (128, 128, 128)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh, in the units of its file."""

    xyz: Float[np.ndarray, "P 3"]
    rgb: UInt8[np.ndarray, "P 3"]


def read_points(mesh: Path, fine_side: int, up: str = "") -> SurfacePoints:
    """Points dense enough for a grid of `fine_side` voxels along each side of the mesh's box. `up`: the axis (y, z)
    that points up in the file; that of its kind when empty.

    Raises InputError for a file that is too large, is no mesh, or has no area.
    """
    parts = list(_parts(mesh))
    count = sum(len(part.triangles) for part in parts)
    if not 0 < count <= MAX_TRIANGLES:
        raise InputError(f"{mesh} has {count:,} triangles; 1 to {MAX_TRIANGLES:,} are read. Export the surface again.")
    triangles = np.concatenate([np.asarray(part.triangles, np.float64) for part in parts])
    corners = triangles.reshape(-1, 3)
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e9:
        raise InputError(f"{mesh} has coordinates that are not finite or beyond 1e9. Repair or scale it.")
    sizes = np.ptp(corners, axis=0)
    if not sizes.max() > 0:
        raise InputError(f"{mesh} is a single point. Export it again.")
    voxel = np.maximum(sizes, sizes.max() / fine_side) / fine_side
    chosen, weights = spread_over(triangles / voxel)
    xyz = np.einsum("pk,pkd->pd", weights, triangles[chosen])
    first = np.cumsum([0, *(len(part.triangles) for part in parts)])
    rgb = np.empty((len(xyz), 3), np.uint8)
    for part, start, stop in zip(parts, first[:-1], first[1:], strict=True):
        mine = (chosen >= start) & (chosen < stop)
        rgb[mine] = _colors(part, chosen[mine] - start, weights[mine])
    y_up = mesh.suffix.lower() in Y_UP if up == "" else up == "y"
    return SurfacePoints(np.stack([xyz[:, 0], -xyz[:, 2], xyz[:, 1]], axis=1) if y_up else xyz, rgb)


def spread_over(triangles: Float[np.ndarray, "T 3 3"]) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P 3"]]:
    """Triangles and barycentric places on them, in proportion to their area, POINTS_PER_FACE per unit of it; each
    triangle's corners come first, so that none is lost."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    until = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    count = int(min(max(POINTS_PER_FACE * until[-1], POINTS_PER_MESH[0]), POINTS_PER_MESH[1]))
    number = np.arange(1, count + 1)
    chosen = np.searchsorted(until, (number * PLASTIC[0] % 1) * until[-1], side="right").clip(0, len(triangles) - 1)
    u, v = number * PLASTIC[1] % 1, number * PLASTIC[2] % 1
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    corners = np.repeat(np.arange(len(triangles)), 3)[: POINTS_PER_MESH[1]]
    return np.concatenate([corners, chosen]), np.concatenate(
        [np.tile(np.eye(3), (len(triangles), 1))[: len(corners)], weights]
    )


def _parts(mesh: Path) -> Iterator[Any]:
    """The meshes of a file, in its coordinates."""
    trimesh = require("trimesh", "library", "Reading meshes")
    if mesh.suffix.lower() not in SUFFIXES:
        raise InputError(f"A mesh must be one of {', '.join(SUFFIXES)}; got {mesh.name}. Convert it first.")
    try:
        size = mesh.stat().st_size
        if not 0 < size <= MAX_BYTES:
            raise InputError(f"{mesh} must hold 1 to {MAX_BYTES:,} bytes, got {size:,}. Export or decimate it again.")
        scene = trimesh.load_scene(str(mesh), process=False)
        found = scene.dump()
    except InputError:
        raise
    except Exception as error:  # its parsers raise whatever they stumble over
        raise InputError(f"Cannot read {mesh}: {type(error).__name__}: {error!s:.200}. Export it again.") from error
    for part in found:
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            yield part


def _colors(part: Any, chosen: Int[np.ndarray, "P"], weights: Float[np.ndarray, "P 3"]) -> UInt8[np.ndarray, "P 3"]:
    """The part's texture, vertex colors, or plain color at places on its triangles."""
    visual = part.visual
    corners = np.asarray(part.faces)[chosen]
    if visual.kind == "texture":
        material = visual.material
        image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if image is not None and visual.uv is not None and len(visual.uv):
            return _texture(image, np.einsum("pk,pkd->pd", weights, np.asarray(visual.uv)[corners]))
        return np.broadcast_to(np.asarray(material.main_color, np.uint8)[:3], (len(chosen), 3))
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[:, :3].astype(np.float64)
        return np.einsum("pk,pkd->pd", weights, colors[corners]).round().astype(np.uint8)
    if visual.kind == "face":
        return np.asarray(visual.face_colors)[chosen, :3].astype(np.uint8)
    return np.broadcast_to(np.array(GRAY, np.uint8), (len(chosen), 3))


def _texture(image: Any, uv: Float[np.ndarray, "P 2"]) -> UInt8[np.ndarray, "P 3"]:
    """Nearest pixels; the texture repeats, its v axis points up."""
    small = image.convert("RGB")
    small.thumbnail((MAX_TEXTURE_SIDE, MAX_TEXTURE_SIDE))
    pixels = np.asarray(small)
    height, width = pixels.shape[:2]
    place = np.where(np.isfinite(uv), uv, 0.0) % 1.0
    column = (place[:, 0] * width).astype(np.int64).clip(0, width - 1)
    row = ((1 - place[:, 1]) * height).astype(np.int64).clip(0, height - 1)
    return pixels[row, column]
