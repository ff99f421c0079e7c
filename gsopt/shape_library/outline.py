"""One photo's evidence of an object's shape: its silhouette, from a known camera."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import world_up
from gsopt.init.inflation import object_box
from gsopt.init.thumbnails import Thumbnail

MARGIN = 1.15
"""Side of the sampled square over that of the silhouette's box."""
REACH = 0.85
"""Half depth of the sampled frustum over the object's size."""


@dataclass(frozen=True)
class Outline:
    """A silhouette and the frame in which shapes are laid over it."""

    camera: Cameras
    alpha: Float[Tensor, "1 H W"]
    box: Float[Tensor, "4"]
    """First and last column and row of the silhouette, px: left, top, right, bottom."""
    middle: Float[Tensor, "3"]
    """Middle of the object, as deep as the camera's focus."""
    depth: float
    size: float
    """Longer side of the silhouette at this depth, scene units: the unit of aligned shapes."""
    upright: Float[Tensor, "3 3"]
    """World from a frame whose z axis is up and whose x axis is level in the image."""

    @staticmethod
    def of(photo: Thumbnail, extent: float) -> Outline:
        """`photo` must show a silhouette."""
        camera, alpha = photo.camera, photo.alpha()
        solid = alpha[0] > 0.5
        middle, _, _ = object_box(camera, solid, extent)
        rows, columns = (torch.nonzero(solid.any(dim=axis))[:, 0] for axis in (1, 0))
        box = torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()
        depth = float((middle - camera.centers[0]) @ camera.forwards[0])
        size = float((box[2:] - box[:2]).max()) / float(camera.Ks[0, 0, 0]) * depth
        return Outline(camera, alpha, box, middle, depth, size, _upright(camera))

    @property
    def sides(self) -> Float[Tensor, "2"]:
        """Width and height of the box, px."""
        return self.box[2:] - self.box[:2]

    def project(self, points: Float[Tensor, "... 3"]) -> Float[Tensor, "... 2"]:
        """Columns and rows of points before the camera, px."""
        seen = self.in_camera(points)
        K = self.camera.Ks[0]
        return seen[..., :2] / seen[..., 2:].clamp_min(1e-6) * K.diagonal()[:2] + K[:2, 2]

    def in_camera(self, points: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3"]:
        """Points in the camera's axes."""
        return points @ self.camera.viewmats[0, :3, :3].T + self.camera.viewmats[0, :3, 3]

    def cropped(self, side: int) -> Float[Tensor, "S S"]:
        """The silhouette's box, stretched to a square: 1 inside."""
        left, top, right, bottom = (int(edge) for edge in self.box)
        solid = (self.alpha[:, top:bottom, left:right] > 0.5).float()
        return torch.nn.functional.interpolate(solid[None], (side, side), mode="area")[0, 0]

    def rays(self, side: int, deep: int) -> tuple[Float[Tensor, "S S D 3"], Float[Tensor, "S S"]]:
        """Points on the rays of side² pixels around the silhouette, world, and the alpha of these pixels."""
        middle, half = (self.box[:2] + self.box[2:]) / 2, MARGIN * float(self.sides.max()) / 2
        steps = (torch.arange(side) + 0.5) / side * 2 - 1
        pixels = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1) * half + middle
        alpha = sample(self.alpha, *pixels.reshape(-1, 2).T)[0].view(side, side)
        K = self.camera.Ks[0]
        ahead = self.depth + ((torch.arange(deep) + 0.5) / deep * 2 - 1) * REACH * self.size
        aside = (pixels - K[:2, 2]) / K.diagonal()[:2]
        points = torch.cat([aside[:, :, None] * ahead[:, None], ahead[:, None].expand(side, side, deep, 1)], dim=-1)
        viewmat = self.camera.viewmats[0]
        return (points - viewmat[:3, 3]) @ viewmat[:3, :3], alpha


def _upright(camera: Cameras) -> Float[Tensor, "3 3"]:
    up = world_up(camera.viewmats)
    level = camera.viewmats[0, 0, :3] - (camera.viewmats[0, 0, :3] @ up) * up
    level = level / level.norm()
    return torch.stack([level, torch.linalg.cross(up, level), up], dim=1)
