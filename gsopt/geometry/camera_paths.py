"""Paths for films: orbit, turntable, ellipse and interpolation, from the cameras of a capture. Cameras in, Cameras out.

All paths keep the image size; orbit and ellipse take the intrinsics of the first camera.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check
from gsopt.errors import InputError
from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.focus import nearest_to_axes, up_direction

FOCUS_DAMPING = 1e-3
"""Damping of `nearest_to_axes`. Stronger than that of `find_focus`: a film stays near cameras whose axes differ by less
than 2 degrees, instead of going around a point far off."""
LEAST_SWING = math.radians(15)
"""Half the least angle of a turntable's swing."""
ELLIPSE_QUANTILE = 0.9
"""Share of the cameras inside the half axes."""
ELLIPSE_FLATTEST = 0.25
"""Least ratio of the two half axes: a row of cameras still gives a path around the subject."""


def focus_point(cameras: Cameras) -> Float[Tensor, "3"]:
    """The point with the least sum of squared distances to the viewing axes, near the cameras if they are parallel."""
    return nearest_to_axes(cameras.centers.double(), cameras.forwards.double(), FOCUS_DAMPING)


def orbit_path(cameras: Cameras, count: int, focus: Float[Tensor, "3"] | None = None) -> Cameras:
    """`count` cameras on one circle around the focus, at the cameras' mean distance and elevation.

    It begins at the first camera's azimuth and ends one step before it comes round again. `focus`: scene units,
    `focus_point` when not given (with a single camera it should be given: one axis leaves the distance open).
    """
    check.at_least("count", count, 1, "Give the number of frames.")
    return _on_circle(cameras, _turn(count), _focus(cameras, focus))


def turntable_path(cameras: Cameras, count: int, focus: Float[Tensor, "3"] | None = None) -> Cameras:
    """An orbit when the cameras stand all around; else a swing to and fro on their side, at least 15 degrees.

    All around: no gap of more than half a turn between their azimuths. A film shows no side that no photo does.
    """
    check.at_least("count", count, 1, "Give the number of frames.")
    focus = _focus(cameras, focus)
    first, width = _covered_arc(cameras, focus)
    if width >= math.pi:
        return _on_circle(cameras, _turn(count), focus)
    swing = max(width / 2, LEAST_SWING) * _turn(count).sin()
    return _on_circle(cameras, first + width / 2 + swing, focus)


def ellipse_path(cameras: Cameras, count: int, focus: Float[Tensor, "3"] | None = None) -> Cameras:
    """`count` cameras on a level ellipse around the focus that follows where the cameras stood.

    Half axes: the 90 % quantile of the cameras' distance from the focus along the two main horizontal directions of
    their spread; height: their mean. Frames are evenly spaced along the ellipse.
    """
    check.at_least("count", count, 1, "Give the number of frames.")
    focus, up = _focus(cameras, focus), up_direction(cameras.viewmats)
    offsets = cameras.centers.double() - focus
    flat = torch.stack(_horizontal_axes(offsets[0], up))
    plane = offsets @ flat.T
    main = torch.linalg.eigh(plane.T @ plane).eigenvectors.T.flip(0)
    reach = torch.quantile((plane @ main.T).abs(), ELLIPSE_QUANTILE, dim=0)
    reach = torch.maximum(reach, ELLIPSE_FLATTEST * reach.max().clamp_min(1e-9))
    angles = _evenly_along_ellipse(reach, count)
    ring = torch.stack([angles.cos(), angles.sin()], dim=1) * reach @ main @ flat
    return _looking(cameras, focus + ring + (offsets @ up).mean() * up, focus, up)


def interpolated_path(cameras: Cameras, count: int) -> Cameras:
    """`count` cameras from the first to the last through all in between, in their order, in equal parameter steps.

    Positions follow a Catmull-Rom spline, rotations the chordal mean of two neighbors, intrinsics a straight line.
    """
    _need_one(cameras)
    check.at_least("count", count, 1, "Give the number of frames.")
    last = len(cameras) - 1
    position = torch.linspace(0, last, count, dtype=torch.float64)
    before = position.floor().long().clamp(max=max(last - 1, 0))
    after, share = (before + 1).clamp(max=last), (position - before)[:, None]
    rotations, Ks = cameras.viewmats[:, :3, :3].double(), cameras.Ks.double()
    centers = _catmull_rom(cameras.centers.double(), before, share)
    R = _nearest_rotation(rotations[before].lerp(rotations[after], share[..., None]))
    viewmats = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    viewmats[:, :3, :3] = R
    viewmats[:, :3, 3] = -(R @ centers[..., None])[..., 0]
    return replace(
        cameras,
        viewmats=viewmats.to(cameras.viewmats),
        Ks=Ks[before].lerp(Ks[after], share[..., None]).to(cameras.Ks),
    )


def _turn(count: int) -> Float[Tensor, " count"]:
    """One turn in equal steps, radians; the end, which is the beginning, left out."""
    return 2 * math.pi * torch.arange(count, dtype=torch.float64) / count


def _on_circle(cameras: Cameras, azimuths: Float[Tensor, " N"], focus: Float[Tensor, "3"]) -> Cameras:
    """Cameras at the mean distance and elevation, azimuths counted from the first camera."""
    up, offsets = up_direction(cameras.viewmats), cameras.centers.double() - focus
    distances = offsets.norm(dim=1).clamp_min(1e-9)
    elevation = float(torch.asin(((offsets @ up) / distances).clamp(-1, 1)).mean())
    ahead, aside = _horizontal_axes(offsets[0], up)
    level = azimuths.cos()[:, None] * ahead + azimuths.sin()[:, None] * aside
    ring = math.cos(elevation) * level + math.sin(elevation) * up
    return _looking(cameras, focus + distances.mean() * ring, focus, up)


def _covered_arc(cameras: Cameras, focus: Float[Tensor, "3"]) -> tuple[float, float]:
    """(start, width) of the shortest arc that holds every camera's azimuth, radians from the first camera."""
    offsets = cameras.centers.double() - focus
    ahead, aside = _horizontal_axes(offsets[0], up_direction(cameras.viewmats))
    azimuths = torch.atan2(offsets @ aside, offsets @ ahead).sort().values
    gaps = torch.cat([azimuths[1:], azimuths[:1] + 2 * math.pi]) - azimuths
    widest = int(gaps.argmax())
    return float(azimuths[(widest + 1) % len(azimuths)]), 2 * math.pi - float(gaps[widest])


def _need_one(cameras: Cameras) -> None:
    if len(cameras) == 0:
        raise InputError("A camera path needs at least one camera, got 0. Give the cameras of the input views.")


def _focus(cameras: Cameras, focus: Tensor | None) -> Float[Tensor, "3"]:
    _need_one(cameras)
    return focus_point(cameras) if focus is None else focus.double()


def _horizontal_axes(ahead: Tensor, up: Tensor) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors perpendicular to `up` and each other, the first towards `ahead` where that is possible."""
    flat = ahead - (ahead @ up) * up
    if flat.norm() < 1e-6 * max(float(ahead.norm()), 1e-12):
        flat = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())])
    flat = flat / flat.norm()
    return flat, torch.linalg.cross(up, flat)


def _looking(cameras: Cameras, eyes: Tensor, focus: Tensor, up: Tensor) -> Cameras:
    return replace(
        cameras,
        viewmats=look_at(eyes, focus, up).to(cameras.viewmats),
        Ks=cameras.Ks[:1].repeat(len(eyes), 1, 1),
    )


def _evenly_along_ellipse(reach: Float[Tensor, "2"], count: int) -> Float[Tensor, " count"]:
    """Angles of `count` points that cut the ellipse into equal arcs (the arc length summed over a fine polygon)."""
    fine = torch.linspace(0, 2 * math.pi, 4096, dtype=torch.float64)
    corners = torch.stack([fine.cos(), fine.sin()], dim=1) * reach
    length = torch.cat([torch.zeros(1, dtype=torch.float64), corners.diff(dim=0).norm(dim=1).cumsum(0)])
    wanted = length[-1] * torch.arange(count, dtype=torch.float64) / count
    right = torch.searchsorted(length, wanted).clamp(1, len(length) - 1)
    share = (wanted - length[right - 1]) / (length[right] - length[right - 1])
    return fine[right - 1].lerp(fine[right], share)


def _catmull_rom(points: Float[Tensor, "C 3"], before: Tensor, share: Float[Tensor, "N 1"]) -> Float[Tensor, "N 3"]:
    """Uniform Catmull-Rom spline (Catmull & Rom 1974); the end points stand twice."""
    last = len(points) - 1
    p0, p1, p2, p3 = (points[(before + step).clamp(0, last)] for step in (-1, 0, 1, 2))
    tangent1, tangent2 = (p2 - p0) / 2, (p3 - p1) / 2
    t = share
    return (
        (2 * t**3 - 3 * t**2 + 1) * p1
        + (t**3 - 2 * t**2 + t) * tangent1
        + (3 * t**2 - 2 * t**3) * p2
        + (t**3 - t**2) * tangent2
    )


def _nearest_rotation(matrices: Float[Tensor, "N 3 3"]) -> Float[Tensor, "N 3 3"]:
    """Closest proper rotations in the Frobenius norm (Kabsch 1976)."""
    U, _, Vh = torch.linalg.svd(matrices)
    sign = torch.ones(len(matrices), 3, dtype=matrices.dtype)
    sign[:, 2] = torch.linalg.det(U @ Vh).sign()
    return U * sign[:, None, :] @ Vh
