"""A closed, decimated, colored surface from a signed distance field.

Marching cubes: Lewiner et al. 2003, from scikit-image. Decimation: quadric error metrics (Garland & Heckbert 1997),
from fast-simplification. Colors: mean of what the views show where a vertex is the surface that they see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from gsopt._optional import require
from gsopt.formats.mesh_files import Mesh
from gsopt.results.mesh.fusion import Box
from gsopt.results.mesh.median_depth import DepthView

SMALLEST_PART = 1 / 200
"""Share of the largest part's voxels below which a part is a floater."""
COLOR_TOLERANCE = 4.0
"""Voxels by which a vertex may lie behind the surface that a view sees and still take its color."""
TAUBIN_ROUNDS, TAUBIN_SHRINK, TAUBIN_SWELL = 5, 0.5, -0.53
"""Rounds of two steps: towards the mean of the neighbors, and a little more away from it."""
HASTES = (7, 5, 3, 2)
"""Errors that a round of the decimation may take at once; less of it folds fewer faces onto each other."""
GRAY = 0.5
PURPOSE = "A mesh"


def tidied(field: Float[Tensor, "X Y Z"]) -> Float[Tensor, "X Y Z"]:
    """The field without floaters and without hollows that nothing connects to the outside."""
    label = require("scipy.ndimage", "mesh", PURPOSE).label
    values = field.numpy().copy()
    parts, count = label(values < 0)
    if count > 1:
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        values[(sizes < SMALLEST_PART * sizes.max())[parts] & (values < 0)] = 1.0
    free, _ = label(np.pad(values >= 0, 1, constant_values=True))
    free = free[1:-1, 1:-1, 1:-1]
    values[(free > 1) & (values >= 0)] = -1.0
    return torch.from_numpy(values)


def triangulated(field: Float[Tensor, "X Y Z"], box: Box) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Vertices in scene units and faces, counterclockwise from outside, of the level 0; closed at the box's sides."""
    marching_cubes = require("skimage.measure", "mesh", PURPOSE).marching_cubes
    padded = np.pad(field.numpy(), 1, constant_values=1.0)
    vertices, faces, _, _ = marching_cubes(padded, 0.0)
    return box.low.numpy() + box.voxel * (vertices - 1), faces.astype(np.int64)


def smoothed(vertices: NDArray[np.float32], faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """The vertices without the steps of the voxels; shrinks nothing (Taubin 1995)."""
    moved, begin = torch.from_numpy(vertices).float(), torch.from_numpy(faces).reshape(-1)
    end = torch.from_numpy(np.roll(faces, -1, axis=1)).reshape(-1)  # every edge stands there once each way
    count = torch.zeros(len(moved)).index_add_(0, begin, torch.ones(len(begin)))[:, None].clamp_min(1)
    for share in (TAUBIN_SHRINK, TAUBIN_SWELL) * TAUBIN_ROUNDS:
        mean = torch.zeros_like(moved).index_add_(0, begin, moved[end]) / count
        moved = moved + share * (mean - moved)
    return moved.numpy()


def decimated(
    vertices: NDArray[np.float32], faces: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """At most `count` faces, fewer where the surface is flat; twice, four times ... as many where so few break it."""
    simplify = require("fast_simplification", "mesh", PURPOSE).simplify
    while count < len(faces):
        for haste in HASTES:
            found = simplify(vertices.astype(np.float32), faces.astype(np.int32), target_count=count, agg=haste)
            fewer, kept = unfolded(found[0], found[1].astype(np.int64))
            if is_closed(kept):
                return fewer, kept
        count *= 2
    return vertices, faces


def unfolded(vertices: NDArray[np.float32], faces: NDArray[np.int64]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Without faces that lie on one another, and with sheets that touch along an edge taken apart there."""
    components = require("scipy.sparse.csgraph", "mesh", PURPOSE).connected_components
    matrix = require("scipy.sparse", "mesh", PURPOSE).coo_array
    _, place, count = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    faces = faces[count[place.reshape(-1)] == 1]
    begin, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    ahead, back = begin * len(vertices) + end, end * len(vertices) + begin
    order = np.argsort(ahead, kind="stable")
    once = np.unique(ahead, return_counts=True)
    single = once[0][once[1] == 1]
    good = np.flatnonzero(np.isin(ahead, single) & np.isin(back, single))  # corners at which a sound edge begins
    other = order[np.searchsorted(ahead, back[good], sorter=order)]  # and those at which its way back begins
    after = np.arange(len(ahead)).reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)
    pairs = np.stack([np.concatenate([good, after[good]]), np.concatenate([after[other], other])])
    links = matrix((np.ones(pairs.shape[1], np.int8), pairs), shape=(len(ahead), len(ahead)))
    number, label = components(links, directed=False)
    moved = np.zeros((number, 3), np.float32)
    moved[label] = vertices[begin]
    return moved, label.reshape(-1, 3).astype(np.int64)


def is_closed(faces: NDArray[np.integer]) -> bool:
    """True when every edge belongs to two faces that run along it in opposite directions."""
    begin, end = faces.astype(np.int64).reshape(-1), np.roll(faces.astype(np.int64), -1, axis=1).reshape(-1)
    stride = int(faces.max()) + 1
    ahead, back = np.sort(begin * stride + end), np.sort(end * stride + begin)
    return bool((ahead == back).all() and (ahead[1:] != ahead[:-1]).all())


def colored(mesh: Mesh, views: Sequence[DepthView], weights: Sequence[float], voxel: float) -> Mesh:
    """The mesh in the colors of the views, those that face a vertex and have more weight counting more."""
    normals = mesh.normals()
    total = torch.zeros(len(mesh.vertices), 4)
    for view, weight in zip(views, weights, strict=True):
        rgba, facing = _shown(view, mesh.vertices, normals, COLOR_TOLERANCE * voxel)
        total += weight * facing[:, None] * rgba
    return replace(mesh, colors=_spread(total, mesh.faces))


def _shown(
    view: DepthView, points: Float[Tensor, "V 3"], normals: Float[Tensor, "V 3"], tolerance: float
) -> tuple[Float[Tensor, "V 4"], Float[Tensor, "V"]]:
    """Premultiplied color and alpha at each point, and its squared cosine to the view where that sees it, else 0."""
    x, y, depth, shown = view.pixels(points)
    seen: Bool[Tensor, "V"] = shown & ((view.depths[y, x] - depth).abs() < tolerance)
    towards = torch.nn.functional.normalize(view.camera.centers[0] - points, dim=-1)
    facing = (towards * normals).sum(-1).clamp_min(0).square()
    rgba = torch.cat([view.colors, view.alphas[..., None]], dim=-1)[y, x]
    return rgba, torch.where(seen, facing, 0)


def _spread(total: Float[Tensor, "V 4"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Straight colors; vertices that no view shows take those of their neighbors, ring by ring."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    known = total[:, 3] > 1e-3
    values = torch.where(known[:, None], total / total[:, 3:].clamp_min(1e-3), 0)
    while not bool(known.all()):
        sums = torch.zeros_like(values).index_add_(0, edges[:, 0], values[edges[:, 1]])
        reached = ~known & (sums[:, 3] > 0)
        if not bool(reached.any()):
            break
        values[reached] = sums[reached] / sums[reached, 3:]
        known = known | reached
    return torch.where(known[:, None], values[:, :3], GRAY).clamp(0, 1)
