"""Mends normals and windings of a mesh that would shade black."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int


SMOOTH_BELOW = math.radians(30.0)


class NormalRepair(NamedTuple):
    """Changes to the normals of a mesh."""

    turned: bool = False
    """Faces were turned."""
    wrong: int = 0
    """Corners whose normal was replaced."""


def mend_normals(bpy: Any, shape: Any, unshaded: bool) -> NormalRepair:
    """Normals that would shade black are replaced.

    Neighbors that wind opposite ways (ShapeNet stores faces from both sides, importers keep one at random) are turned
    alike, and what normals the mesh had are dropped. A corner whose normal points away from its face takes the face's.
    A mesh of a kind without shading of its own and without normals becomes smooth where faces meet gently.
    """
    if not len(shape.polygons):
        return NormalRepair()
    corners = integers(shape.loops, "vertex_index")
    sizes = integers(shape.polygons, "loop_total")
    turned = winding_disagrees(corners, sizes)
    if turned:
        wind_alike(shape)
    if turned or (unshaded and not shape.has_custom_normals):
        if shape.has_custom_normals:
            with bpy.context.temp_override(mesh=shape):
                bpy.ops.mesh.customdata_custom_splitnormals_clear()
        shape.polygons.foreach_set("use_smooth", np.ones(len(shape.polygons), bool))
        shape.set_sharp_from_angle(angle=SMOOTH_BELOW)
        return NormalRepair(turned)
    if not shape.has_custom_normals:
        return NormalRepair()
    normals = vectors(shape.corner_normals, "vector")
    faces = np.repeat(area_vectors(vectors(shape.vertices, "co")[corners], sizes), sizes, axis=0)
    wrong = ~((normals * faces).sum(axis=1) > 0.0) & faces.any(axis=1)
    if not wrong.any():
        return NormalRepair()
    normals[wrong] = faces[wrong] / np.linalg.norm(faces[wrong], axis=1, keepdims=True)
    shape.normals_split_custom_set(normals.tolist())
    return NormalRepair(wrong=int(wrong.sum()))


def winding_disagrees(corners: Int[np.ndarray, "L"], sizes: Int[np.ndarray, "F"]) -> bool:
    """True when the two faces of some edge run along it in the same direction."""
    edges = np.stack([corners, corners[following_corner(sizes)]], axis=1).astype(np.int64)
    forward = edges[:, 0] < edges[:, 1]
    _, edge, faces = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(edge.ravel(), np.where(forward, 1.0, -1.0), len(faces))
    return bool(((faces == 2) & (balance != 0)).any())


def following_corner(sizes: Int[np.ndarray, "F"]) -> Int[np.ndarray, "L"]:
    """The next corner around the same face, for every corner of faces of these sizes."""
    ends = np.repeat(np.cumsum(sizes), sizes)
    following = np.arange(1, len(ends) + 1)
    return np.where(following == ends, ends - np.repeat(sizes, sizes), following)


def area_vectors(corners: Float[np.ndarray, "L 3"], sizes: Int[np.ndarray, "F"]) -> Float[np.ndarray, "F 3"]:
    """Twice the area times the normal that a face's winding gives it (Newell); Blender's own follow custom normals."""
    starts = np.cumsum(sizes) - sizes
    local = corners.astype(np.float64) - np.repeat(corners[starts], sizes, axis=0)
    return np.add.reduceat(np.cross(local, local[following_corner(sizes)]), starts, axis=0)


def wind_alike(shape: Any) -> None:
    """Turn the faces of every connected part the same way, outward as far as there is an outside."""
    import bmesh

    editable = bmesh.new()
    editable.from_mesh(shape)
    bmesh.ops.recalc_face_normals(editable, faces=editable.faces)
    editable.to_mesh(shape)
    editable.free()


def integers(rows: Any, name: str) -> Int[np.ndarray, "N"]:
    """A whole-number property of every row of a Blender collection."""
    values = np.empty(len(rows), np.int32)
    rows.foreach_get(name, values)
    return values


def vectors(rows: Any, name: str) -> Float[np.ndarray, "N 3"]:
    """A 3-vector property of every row of a Blender collection."""
    values = np.empty((len(rows), 3), np.float32)
    rows.foreach_get(name, values.ravel())
    return values
