"""World points in a camera's image."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras


def project(
    camera: Cameras, points: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Pixel column, row and depth of world points in one camera; column and row are NaN or infinite at depth 0.

    Written out by coordinate, so that no matrix product's blocking decides the last bit.
    """
    R, t, K = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3], camera.Ks[0]
    X, Y, Z = points.unbind(-1)
    x, y, z = (X * R[i, 0] + Y * R[i, 1] + Z * R[i, 2] + t[i] for i in range(3))
    return K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2], z


def inside(camera: Cameras, column: Tensor, row: Tensor, depth: Tensor) -> Bool[Tensor, "N"]:
    """True where a projection lies before the camera and within the image."""
    return (depth > 0) & (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)


def sees(camera: Cameras, points: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
    """True for points before the camera whose projection lies within the image."""
    return inside(camera, *project(camera, points))
