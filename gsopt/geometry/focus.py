"""The point that cameras look at, and the up direction that they share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import sees

AXIS_DAMPING = 1e-6
"""Damping of `nearest_to_axes` in `find_focus`: decides only along directions that parallel axes leave open."""
ROLL_DAMPING = 1e-3
"""Weight of the cameras' mean up in `up_direction`; matters where they look the same way.

It tilts a well-settled up by about 1e-4; less of it would let the roll of a shaky hand decide in a narrow capture."""
LEAST_UP_COSINE = 0.5
"""Between the up direction and the cameras' mean up: at more than 60 degrees the mean up is taken."""
MAX_ROLL = 0.05
"""Vertical component of a camera's right axis up to which the world's z axis counts as up."""
_IN_FRONT = 0.8
"""Share of the cameras that must have the focus before them."""


@dataclass(frozen=True)
class Focus:
    """The place the cameras look at."""

    point: Float[Tensor, "3"]
    distance: float
    """Median distance of the cameras to it, scene units."""
    radius: float
    """Radius of the ball around it that the median camera just frames along its shorter side, scene units."""
    converging: bool
    """False when the axes do not meet before the cameras (parallel, outward or a single view): then it is a guess."""


def find_focus(cameras: list[Cameras], extent: float) -> Focus:
    """The point nearest to all viewing axes by least squares, or a guess `5 * extent` ahead of the mean camera.

    Axes that do not converge give the origin where it stands before every camera, inside its image: captures of
    objects put the object there.
    """
    centers = torch.cat([camera.centers for camera in cameras]).double()
    axes = torch.cat([camera.forwards for camera in cameras]).double()
    mean, point = centers.mean(0), nearest_to_axes(centers, axes, AXIS_DAMPING)
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


def world_up(viewmats: Float[Tensor, "C 4 4"]) -> Float[Tensor, "3"]:
    """The z axis, as datasets of objects have it, unless a camera is rolled against it; else the cameras' own up."""
    right, down = viewmats[:, 0, :3], viewmats[:, 1, :3]
    if float(right[:, 2].abs().max()) <= MAX_ROLL and float(down[:, 2].max()) < 0:
        return torch.tensor([0.0, 0.0, 1.0])
    return up_direction(viewmats).float()


def nearest_to_axes(centers: Float[Tensor, "C 3"], axes: Float[Tensor, "C 3"], damping: float) -> Float[Tensor, "3"]:
    """Minimizes sum_i |(I - a_i a_iᵀ)(p - c_i)|² + damping C |p - mean(c)|² over p.

    `damping` decides along directions in which the axes differ by less than about its square root in radians, and
    pulls the point towards the cameras there. 0 leaves it open: the caller checks the condition of `across_axes`.
    """
    across, pull = across_axes(axes), damping * len(centers)
    A = across.sum(0) + pull * torch.eye(3, dtype=centers.dtype)
    b = (across @ centers[..., None]).sum(0)[:, 0] + pull * centers.mean(0)
    return torch.linalg.solve(A, b)


def across_axes(axes: Float[Tensor, "C 3"]) -> Float[Tensor, "C 3 3"]:
    """I - a aᵀ: removes what lies along each axis."""
    return torch.eye(3, dtype=axes.dtype, device=axes.device) - axes[:, :, None] * axes[:, None, :]


def up_direction(
    viewmats: Float[Tensor, "C 4 4"], damping: float = ROLL_DAMPING, least_cosine: float = LEAST_UP_COSINE
) -> Float[Tensor, "3"]:
    """Unit vector closest to perpendicular to all horizontal image axes: the world's up if nobody tilts the camera.

    Unlike the mean of the cameras' up it does not lean when all of them look down from one side. The mean up decides
    when the horizontal axes leave it open (within `damping`) or contradict it (a cosine below `least_cosine`).
    """
    right, up = viewmats[:, 0, :3].double(), -viewmats[:, 1, :3].double()
    mean = up.mean(0)
    mean = mean / mean.norm() if mean.norm() > 1e-6 else up[0] / up[0].norm()
    identity = torch.eye(3, dtype=torch.float64)
    cost = (right[:, :, None] * right[:, None, :]).mean(0) + damping * (identity - torch.outer(mean, mean))
    level = torch.linalg.eigh(cost).eigenvectors[:, 0]
    level = level if level @ mean > 0 else -level
    return level if float(level @ mean) > least_cosine else mean
