"""A mirror plane, and the photo that a camera behind it would take."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras


@dataclass(frozen=True)
class Mirror:
    """The plane normal · x = offset."""

    normal: Float[Tensor, "3"]
    """Unit vector."""
    offset: float
    """Scene units."""
    freedom: ClassVar[int] = 3
    """Numbers that `moved` takes."""

    def distance(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
        """Signed, scene units; written out by coordinate, so that no matrix product's blocking decides the last bit."""
        x, y, z = self.normal.tolist()
        return points[..., 0] * x + points[..., 1] * y + points[..., 2] * z - self.offset

    def reflect(self, points: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N 3"]:
        """Mirror images of the points."""
        return points - 2 * self.distance(points)[..., None] * self.normal

    def images(self, points: Float[Tensor, "*N 3"]) -> Iterator[Float[Tensor, "*N 3"]]:
        """The one mirror image of the points."""
        yield self.reflect(points)

    def camera(self, camera: Cameras) -> Cameras:
        """The camera's mirror image. Its view of a symmetric object is the camera's photo, read from right to
        left: with M the reflection and F = diag(-1, 1, 1), cam_from_world is F V M, again a rigid motion."""
        n = self.normal.double()
        reflection = torch.eye(4, dtype=torch.float64)
        reflection[:3, :3] -= 2 * n[:, None] * n
        reflection[:3, 3] = 2 * self.offset * n
        flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
        viewmats = (flip @ camera.viewmats.double() @ reflection).to(camera.viewmats)
        Ks = camera.Ks.clone()
        Ks[:, 0, 2] = camera.width - Ks[:, 0, 2]
        return replace(camera, viewmats=viewmats, Ks=Ks)

    def moved(self, change: Float[Tensor, "3"], center: Float[Tensor, "3"], radius: float) -> Mirror:
        """The plane turned about a center by two small angles and shifted by a share of the radius."""
        n = self.normal
        axis = torch.eye(3)[int(n.abs().numpy().argmin())]
        u = torch.nn.functional.normalize(torch.linalg.cross(n, axis), dim=0)
        normal = torch.nn.functional.normalize(n + change[0] * u + change[1] * torch.linalg.cross(n, u), dim=0)
        shift = self.offset - float(n @ center) + float(change[2]) * radius
        return Mirror(normal, float(normal @ center) + shift)
