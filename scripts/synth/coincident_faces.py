"""Separates the two sides of sheets modeled in one plane, because each would shadow the other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

GAP = 1e-4
"""Distance that each side moves outward, share of the mesh's extent: a fortieth of a pixel when it fills 256 pixels."""
TOUCH = 1e-5
"""Sides closer than this, in the same measure, lie in one plane."""
OPPOSITE = -0.999
"""Most cosine between the normals of two sides of a sheet."""


def separate_coincident_faces(shape: Any) -> int:
    """Move faces that lie on a face of opposite normal outward by `GAP`; returns how many there are.

    Modeling tools close sheets so, often with other triangles on either side. A renderer's shadow rays start on one
    side and end at once on the other: black. Corners that both sides share stay where they are.
    """
    from mathutils.bvhtree import BVHTree

    corners = np.array([corner.co for corner in shape.vertices], np.float64).reshape(-1, 3)
    extent = float(np.ptp(corners, axis=0).max(initial=0.0))
    if not 0.0 < extent < np.inf:
        return 0
    tree = BVHTree.FromPolygons(corners.tolist(), [tuple(face.vertices) for face in shape.polygons])
    moves, twins = np.zeros_like(corners), 0
    for face in shape.polygons:
        near = tree.find_nearest_range(face.center, TOUCH * extent)
        if any(normal.dot(face.normal) < OPPOSITE for _, normal, other, _ in near if other != face.index):
            moves[list(face.vertices)] += face.normal
            twins += 1
    if twins:
        shape.vertices.foreach_set("co", moved(corners, moves, GAP * extent).astype(np.float32).ravel())
        shape.update()
    return twins


def moved(
    corners: Float[np.ndarray, "V 3"], ways: Float[np.ndarray, "V 3"], distance: float
) -> Float[np.ndarray, "V 3"]:
    """Corners with a way to go, `distance` along it."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return corners + distance * np.where(length > 1e-3, ways / np.maximum(length, 1e-3), 0.0)
