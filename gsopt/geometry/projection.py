"""What the cameras alone say about where the scene is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras

_PULL = 1e-6
"""Weight of the mean centre against the axes: decides only along directions that parallel axes leave open."""
_IN_FRONT = 0.8
"""Share of the cameras that must have the focus before them."""


@dataclass(frozen=True)
class Focus:
    """The place the cameras look at."""

    point: Float[Tensor, "3"]
    distance: float
    """Median distance of the cameras to it, scene units."""
    radius: float
    """Of the ball around it that the median camera just frames along its shorter side, scene units."""
    converging: bool
    """False when the axes do not meet before the cameras (parallel, outward or a single view): then it is a guess."""


def find_focus(cameras: list[Cameras], extent: float) -> Focus:
    """The point nearest to all viewing axes by least squares, or a guess `5 * extent` ahead of the mean camera.

    Minimises sum_i |(I - a_i a_iᵀ)(p - c_i)|² over p, with a weak pull to the mean centre. Where the axes do not
    converge but the origin stands before every camera, inside its image, it is the origin: captures of objects put
    the object there.
    """
    centers = torch.cat([camera.centers for camera in cameras]).double()
    axes = torch.cat([camera.forwards for camera in cameras]).double()
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    mean = centers.mean(0)
    A = across.sum(0) + _PULL * len(cameras) * torch.eye(3, dtype=torch.float64)
    b = (across @ centers[..., None]).sum(0)[:, 0] + _PULL * len(cameras) * mean
    point = torch.linalg.solve(A, b)
    ahead = ((point - centers) * axes).sum(-1)
    converging = len(cameras) > 1 and float((ahead > 0.1 * extent).double().mean()) >= _IN_FRONT
    if not converging:
        origin = torch.zeros(1, 3)
        if all(bool(sees(camera, origin)[0]) for camera in cameras):
            point = origin[0].double()
        else:
            point = mean + 5 * extent * axes.mean(0)
    half_views = [min(c.width / float(c.Ks[0, 0, 0]), c.height / float(c.Ks[0, 1, 1])) / 2 for c in cameras]
    distances = (point - centers).norm(dim=-1).clamp(min=1e-6)
    radii = distances * torch.tensor(half_views, dtype=torch.float64)
    return Focus(point.float(), float(distances.median()), float(radii.median()), converging)


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
