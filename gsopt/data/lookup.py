"""Values of pictures where their cameras show points of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.cpu_backend import workspace
from gsopt.raster.threads import preparing_threads


@dataclass(frozen=True)
class Picture:
    """A camera and its image, at any resolution."""

    camera: Cameras
    image: Float[Tensor, "FH FW"]
    unseen: float
    """Value of a point that it does not show."""

    @cached_property
    def parts(self) -> tuple[Any, ...]:
        """As the kernel takes it."""
        R, t = self.camera.viewmats[0, :3, :3].flatten().tolist(), self.camera.viewmats[0, :3, 3].tolist()
        (fx, _, cx), (_, fy, cy), _ = self.camera.Ks[0].tolist()
        return R, t, (fx, fy, cx, cy, self.camera.width, self.camera.height), self.image.contiguous(), self.unseen


def lowest(
    pictures: Sequence[Picture],
    points: Float[Tensor, "*N 3"],
    *,
    beside: float | None = None,
    radius: float = 0.0,
    enough: float = -math.inf,
) -> tuple[Float[Tensor, "*N"], Int32[Tensor, "*N"]]:
    """The lowest of the bilinear values at a point's projections, and the number of pictures that show the point; for
    a value that is no higher than `enough` perhaps not of all pictures. A point before the camera that projects beside
    its image has the border's value; or, where `beside` is given, that, if the camera sees something within `radius`
    (scene units) of the point."""
    values, shown = torch.empty(points.shape[:-1]), torch.empty(points.shape[:-1], dtype=torch.int32)
    parts = [picture.parts for picture in pictures]
    _cpu.lookup(workspace(preparing_threads()), points.contiguous(), parts, beside, radius, enough, values, shown)
    return values, shown
