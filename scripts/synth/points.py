"""Surface samples with the color that the views show: what structure from motion would have found."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from synth.cameras import Shot

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, UInt8

CANDIDATES = 4
"""Samples drawn for each point wanted: those that no view sees are dropped."""
DEPTH_TOLERANCE = 0.01
"""Largest distance from the depth map at which a sample counts as visible, world units."""
GRAZING = 0.2
"""A view that sees the surface at less than this cosine tells neither its color nor whether it is hidden."""


class SurfacePoints:
    """Candidates on the surface that gather color from one view after the other."""

    def __init__(self, triangles: Float[np.ndarray, "T 3 3"], count: int, seed: int) -> None:
        self.wanted = count
        self.xyz, self.normals = sample_surface(triangles, CANDIDATES * count, np.random.default_rng([seed, 2]))
        self.sums = np.zeros((len(self.xyz), 3))
        self.facing = np.zeros((len(self.xyz), 3))
        self.views = np.zeros(len(self.xyz), np.int64)

    def see(self, shot: Shot, rgba: UInt8[np.ndarray, "H W 4"], depth: Float32[np.ndarray, "H W"]) -> None:
        """Add the color of the pixel that each sample falls on, where nothing hides it."""
        cam_from_world = np.linalg.inv(shot.world_from_cam)
        cam = self.xyz @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        z = np.maximum(-cam[:, 2], 1e-9)
        column = np.floor(shot.center[0] + shot.focal * cam[:, 0] / z).astype(np.int64)
        row = np.floor(shot.center[1] - shot.focal * cam[:, 1] / z).astype(np.int64)
        height, width = depth.shape
        inside = (cam[:, 2] < 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = row.clip(0, height - 1), column.clip(0, width - 1)
        away = shot.eye - self.xyz
        steep = np.abs((away * self.normals).sum(axis=1)) > GRAZING * np.linalg.norm(away, axis=1)
        seen = np.nonzero(inside & steep & (depth[at] > 0) & (np.abs(z - depth[at]) < DEPTH_TOLERANCE))[0]
        self.sums[seen] += rgba[at][seen, :3]
        self.facing[seen] += away[seen]
        self.views[seen] += 1

    def found(
        self,
    ) -> tuple[Float32[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
        """Position, unit normal towards the views, and mean color of the first seen samples, as many as wanted."""
        kept = np.nonzero(self.views)[0][: self.wanted]
        normals = self.normals[kept]
        away = (normals * self.facing[kept]).sum(axis=1) < 0  # files disagree about which side is out
        normals[away] *= -1.0
        colors = np.rint(self.sums[kept] / self.views[kept, None]).astype(np.uint8)
        return self.xyz[kept].astype(np.float32), normals.astype(np.float32), colors


def sample_surface(
    triangles: Float[np.ndarray, "T 3 3"], count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Points uniform by area and the normals of their triangles; none when the surface has no area."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    edges = np.cumsum(doubled)
    if not count or not edges[-1] > 0:
        return np.empty((0, 3)), np.empty((0, 3))
    chosen = np.searchsorted(edges, rng.uniform(0.0, edges[-1], count), side="right").clip(max=len(edges) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u), np.where(folded, 1.0 - v, v)
    a, b, c = triangles[chosen].swapaxes(0, 1)
    return a + u * (b - a) + v * (c - a), cross[chosen] / doubled[chosen, None]


def ply(xyz: Float32[np.ndarray, "P 3"], normals: Float32[np.ndarray, "P 3"], rgb: UInt8[np.ndarray, "P 3"]) -> bytes:
    """A binary PLY with positions, normals and colors."""
    names = [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(xyz), names)
    columns: Iterable = (*xyz.T, *normals.T, *rgb.T)
    for (name, _), column in zip(names, columns, strict=True):
        rows[name] = column
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in names] + ["end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
