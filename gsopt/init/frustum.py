"""Random points in view of the cameras: beside those of stereo, or where a scene tells nothing of its shape."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import sees

BACKGROUND_SHARE = 0.3
"""Share of the points beyond the common region, where the scene has a background (no alpha)."""
BACKGROUND_FAR = 8.0
"""Depth of the farthest background point, in distances to the focus."""
CLEAR_OF_CAMERAS = 0.75
"""Distance of background points to all cameras, in distances to the focus."""
_MAX_ROUNDS = 32


def random_points(
    cameras: list[Cameras], focus: Focus, count: int, background: bool, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """`count` points: uniform in the ball the cameras frame, where at least half of them see it.

    With `background`, BACKGROUND_SHARE of them lie behind it. If the axes do not converge, all of them lie along random
    pixels.
    """
    if not focus.converging:
        return background_points(cameras, focus, count, generator)
    behind = round(BACKGROUND_SHARE * count) if background else 0
    common = _in_common_region(cameras, focus, count - behind, generator)
    return torch.cat([common, background_points(cameras, focus, behind, generator)])


def background_points(
    cameras: list[Cameras], focus: Focus, count: int, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """`count` points along random pixels, uniform in inverse depth: behind the focus and clear of all cameras, since
    whoever walks around a thing walks where others see the background. If the axes do not converge, from a fifth of the
    focus distance on."""
    far = BACKGROUND_FAR * focus.distance
    if not focus.converging:
        return _along_pixels(cameras, count, 0.2 * focus.distance, far, generator)
    centers, reach = torch.cat([camera.centers for camera in cameras]), CLEAR_OF_CAMERAS * focus.distance
    return _accepted(
        lambda wanted: _along_pixels(cameras, wanted, focus.distance, far, generator),
        lambda points: torch.cdist(points, centers).amin(1) >= reach,
        count,
    )


def _in_common_region(
    cameras: list[Cameras], focus: Focus, count: int, generator: torch.Generator
) -> Float[Tensor, "N 3"]:
    """Uniform in the ball around the focus, rejecting what fewer than half of the cameras see."""

    def is_common(points: Float[Tensor, "N 3"]) -> Bool[Tensor, "N"]:
        seen = torch.zeros(len(points), dtype=torch.int32)
        for camera in cameras:
            seen += sees(camera, points)
        return 2 * seen >= len(cameras)

    return _accepted(lambda wanted: focus.point + focus.radius * _in_unit_ball(wanted, generator), is_common, count)


def _accepted(
    draw: Callable[[int], Float[Tensor, "N 3"]],
    is_fit: Callable[[Float[Tensor, "N 3"]], Bool[Tensor, "N"]],
    count: int,
) -> Float[Tensor, "N 3"]:
    """`count` of the points drawn that fit; where hardly any does, as with cameras that hardly overlap, others too."""
    accepted = torch.empty(0, 3)
    for _ in range(_MAX_ROUNDS):
        points = draw(count)
        accepted = torch.cat([accepted, points[is_fit(points)]])[:count]
        if len(accepted) == count:
            return accepted
    return torch.cat([accepted, draw(count - len(accepted))])


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
