"""Random points in view of the cameras, for scenes that come with neither points nor silhouettes."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import sees

BACKGROUND_SHARE = 0.3
"""Share of the points beyond the common region, where the scene has a background (no alpha)."""
BACKGROUND_FAR = 8.0
"""Depth of the farthest background point, in distances to the focus."""
_MAX_ROUNDS = 32


def random_points(
    cameras: list[Cameras], focus: Focus, count: int, background: bool, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """`count` points: uniform in the ball the cameras frame, where at least half of them see it.

    With `background`, BACKGROUND_SHARE of them lie along random pixels behind the focus, uniform in inverse depth.
    If the axes do not converge, all of them lie along random pixels, from a fifth of the focus distance on.
    """
    if not focus.converging:
        return _along_pixels(cameras, count, 0.2 * focus.distance, BACKGROUND_FAR * focus.distance, generator)
    behind = round(BACKGROUND_SHARE * count) if background else 0
    common = _in_common_region(cameras, focus, count - behind, generator)
    far = _along_pixels(cameras, behind, focus.distance, BACKGROUND_FAR * focus.distance, generator)
    return torch.cat([common, far])


def _in_common_region(
    cameras: list[Cameras], focus: Focus, count: int, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Uniform in the ball around the focus, rejecting what fewer than half of the cameras see."""
    accepted: list[Tensor] = []
    for _ in range(_MAX_ROUNDS):
        points = focus.point + focus.radius * _in_unit_ball(count, generator)
        seen = torch.zeros(count, dtype=torch.int32)
        for camera in cameras:
            seen += sees(camera, points)
        accepted.append(points[2 * seen >= len(cameras)])
        if sum(map(len, accepted)) >= count:
            return torch.cat(accepted)[:count]
    # Cameras that hardly overlap: keep what there is and fill up from the ball.
    missing = count - sum(map(len, accepted))
    return torch.cat([*accepted, focus.point + focus.radius * _in_unit_ball(missing, generator)])


def _in_unit_ball(count: int, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return direction * torch.rand(count, 1, generator=generator) ** (1 / 3)


def _along_pixels(
    cameras: list[Cameras], count: int, near: float, far: float, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Random camera, random place in its image, depth uniform in inverse depth between `near` and `far`."""
    chosen = torch.randint(len(cameras), (count,), generator=generator)
    u, v, w = torch.rand(3, count, generator=generator).unbind(0)
    depth = 1 / (1 / far + (1 / near - 1 / far) * w)
    points = torch.empty(count, 3)
    for index, camera in enumerate(cameras):
        mine = torch.nonzero(chosen == index)[:, 0]
        K, R = camera.Ks[0], camera.viewmats[0, :3, :3]
        x = (u[mine] * camera.width - K[0, 2]) / K[0, 0] * depth[mine]
        y = (v[mine] * camera.height - K[1, 2]) / K[1, 1] * depth[mine]
        # Rotate back by the transposed rotation: world = Rᵀ x_cam + center.
        points[mine] = x[:, None] * R[0] + y[:, None] * R[1] + depth[mine, None] * R[2] + camera.centers[0]
    return points
