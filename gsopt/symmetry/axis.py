"""An axis that an object may be turned about, and the photos that cameras turned about it would take."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.init.thumbnails import Thumbnail

MIDDLE_DAMPING = 1e-4
"""Weight of the focus in `middle_axis`, next to 1 for a photo."""


@dataclass(frozen=True)
class Axis:
    """The line point + t direction. An object is the same after each of so many equal turns about it."""

    direction: Float[Tensor, "3"]
    """Unit vector."""
    point: Float[Tensor, "3"]
    """Scene units."""
    turns: int
    freedom: ClassVar[int] = 2
    """Numbers that `moved` takes."""

    def distance(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """From the axis, scene units."""
        return torch.linalg.cross(points - self.point, self.direction.expand_as(points)).norm(dim=-1)

    def rotation(self, turn: int) -> Float[Tensor, "3 3"]:
        """The matrix of so many turns, in float64 (Rodrigues)."""
        x, y, z = self.direction.double().tolist()
        cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
        angle = 2 * math.pi * turn / self.turns
        return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross

    def images(self, points: Float[Tensor, "*N 3"]) -> Iterator[Float[Tensor, "*N 3"]]:
        """The points after every turn but the last, which takes them home."""
        for turn in range(1, self.turns):
            yield (points - self.point) @ self.rotation(turn).T.to(points) + self.point

    def cameras(self, camera: Cameras) -> Iterator[Cameras]:
        """The camera after each of these turns; its view of the object is the camera's photo. With x -> R (x - p) + p
        the turn and V cam_from_world, the turned camera's is V after the turn back."""
        for turn in range(1, self.turns):
            back = torch.eye(4, dtype=torch.float64)
            back[:3, :3] = self.rotation(turn).T
            back[:3, 3] = self.point.double() - back[:3, :3] @ self.point.double()
            yield replace(camera, viewmats=(camera.viewmats.double() @ back).to(camera.viewmats))

    def moved(self, change: Float[Tensor, "2"], center: Float[Tensor, "3"], radius: float) -> Axis:
        """The axis shifted sideways by two shares of the radius, wherever the center is."""
        u = perpendicular(self.direction)
        sideways = change[0] * u + change[1] * torch.linalg.cross(self.direction, u)
        return replace(self, point=self.point + radius * sideways)


def perpendicular(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """A unit vector across another."""
    other = torch.eye(3)[int(direction.abs().numpy().argmin())]
    return torch.nn.functional.normalize(torch.linalg.cross(direction, other), dim=0)


def middle_axis(photos: list[Thumbnail], up: Float[Tensor, "3"], focus: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """A point of the upright line that passes the middles of the silhouettes most nearly, as near to the focus as
    they permit."""
    A, b = MIDDLE_DAMPING * torch.eye(3), torch.zeros(3)
    for photo in photos:
        across = torch.nn.functional.normalize(torch.linalg.cross(_middle_ray(photo), up), dim=0)
        A = A + across[:, None] * across
        b = b + across * (across @ (photo.camera.centers[0] - focus))
    return focus + torch.linalg.solve(A, b)


def _middle_ray(photo: Thumbnail) -> Float[Tensor, "3"]:
    """The direction in which the camera sees the centroid of the silhouette."""
    alpha, K = photo.alpha()[0], photo.camera.Ks[0]
    row, column = ((alpha.sum(1 - axis) * (torch.arange(alpha.shape[axis]) + 0.5)).sum() for axis in (0, 1))
    pixel = torch.stack([column, row]) / alpha.sum().clamp_min(1e-6)
    return torch.cat([(pixel - K[:2, 2]) / K.diagonal()[:2], torch.ones(1)]) @ photo.camera.viewmats[0, :3, :3]
