"""Cameras all around a place, where nobody stood."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.focus import world_up

HEIGHTS = (-0.1, 0.95)
"""Sines of the lowest and highest elevation of the cameras."""
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def surrounding_cameras(camera: Cameras, middle: Float[Tensor, "3"], count: int) -> Cameras:
    """Cameras on a spiral around a place (Fibonacci), at the distance of `camera`, with its lens and size."""
    distance = float((camera.centers[0] - middle).norm())
    number = torch.arange(count) + 0.5
    height = HEIGHTS[0] + (HEIGHTS[1] - HEIGHTS[0]) * number / count
    angle, level = number * GOLDEN_ANGLE, (1 - height**2).sqrt()
    up = world_up(camera.viewmats)
    ahead = torch.linalg.cross(up, camera.viewmats[0, 0, :3])
    ahead = ahead / ahead.norm()
    aside = torch.linalg.cross(up, ahead)
    offsets = (level * angle.cos())[:, None] * ahead + (level * angle.sin())[:, None] * aside + height[:, None] * up
    viewmats = look_at(middle + distance * offsets, middle, up).to(camera.viewmats)
    return replace(camera, viewmats=viewmats, Ks=camera.Ks.repeat(count, 1, 1))
