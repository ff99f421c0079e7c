"""The cube around an object in which a shape prior works, and views of it, cropped to their silhouettes.

A point q of the cube, in [-1, 1]³, lies at x = c + h Aᵀ q in the world: c is the middle of the object, h half the
cube's side, and the rows of A point right and ahead, both level, and up, all as the first camera stands. A crop maps q
to (u d, v d, d) = P (q, 1), with u and v in [-1, 1] and the depth d in units of h.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.focus import across_axes

FILL = 0.85
"""Longer side of a silhouette's box over that of its crop."""
CUBE_MARGIN = 1.5
"""Side of the cube over the longer side of the largest box: the unseen depth may exceed what is seen."""
DAMPING = 1e-6
NEAREST = 0.05
"""Least depth of anything drawn, in units of h."""


@dataclass(frozen=True)
class Frame:
    """Cubes of B objects in the world."""

    middle: Float[Tensor, "B 3"]
    half: Float[Tensor, "B"]
    axes: Float[Tensor, "B 3 3"]
    """World to cube, rows right, ahead and up."""

    def to_cube(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
        """World points in cube coordinates."""
        return (points - self.middle[:, None]) @ self.axes.mT / self.half[:, None, None]

    def to_world(self, points: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N 3"]:
        """Inverse of `to_cube`."""
        return self.middle[:, None] + self.half[:, None, None] * points @ self.axes


@dataclass(frozen=True)
class Views:
    """V cameras around each of B objects, and the boxes of the silhouettes in them."""

    viewmats: Float[Tensor, "B V 4 4"]
    Ks: Float[Tensor, "B V 3 3"]
    boxes: Float[Tensor, "B V 4"]
    """Left, top, right, bottom, px."""

    def crop_half(self) -> Float[Tensor, "B V"]:
        """Half sides of the crops, px."""
        return (self.boxes[..., 2:] - self.boxes[..., :2]).amax(-1) / (2 * FILL)

    def frame(self, depth: Float[Tensor, "B"], up: Float[Tensor, "3"]) -> Frame:
        """The cubes. `depth`: that of each object in a single view, scene units; several views find it themselves."""
        R, t = self.viewmats[..., :3, :3], self.viewmats[..., :3, 3]
        eyes = -(R.mT @ t[..., None])[..., 0]
        focal = self.Ks[..., [0, 1], [0, 1]]
        aside = ((self.boxes[..., :2] + self.boxes[..., 2:]) / 2 - self.Ks[..., :2, 2]) / focal
        rays = (torch.cat([aside, torch.ones_like(aside[..., :1])], -1)[..., None, :] @ R)[..., 0, :]
        middle = eyes[:, 0] + depth[:, None] * rays[:, 0] if eyes.shape[1] == 1 else _nearest(eyes, rays)
        away = ((middle[:, None] - eyes) * R[..., 2, :]).sum(-1).clamp_min(1e-6)
        seen = (self.boxes[..., 2:] - self.boxes[..., :2]).amax(-1) / focal[..., 0] * away
        ahead = torch.nn.functional.normalize(torch.linalg.cross(up.expand_as(middle), R[:, 0, 0]), dim=-1)
        axes = torch.stack([torch.linalg.cross(ahead, up.expand_as(ahead)), ahead, up.expand_as(ahead)], dim=1)
        return Frame(middle, CUBE_MARGIN / 2 * seen.amax(1), axes)

    def crops(self, place: Float[Tensor, "B 3"], linear: Float[Tensor, "B 3 3"], unit: Float[Tensor, "B"]) -> Tensor:
        """P of every view for points x = place + linear q, with depths in `unit`s: [B, V, 3, 4]."""
        R, t = self.viewmats[..., :3, :3], self.viewmats[..., :3, 3]
        K = self.Ks.clone()
        half = self.crop_half()
        K[..., 0, 2] -= (self.boxes[..., 0] + self.boxes[..., 2]) / 2
        K[..., 1, 2] -= (self.boxes[..., 1] + self.boxes[..., 3]) / 2
        K[..., :2, :] = K[..., :2, :] / half[..., None, None]
        moved = (R @ place[:, None, :, None])[..., 0] + t
        pose = torch.cat([R @ linear[:, None], moved[..., None]], -1) / unit[:, None, None, None]
        return K @ pose

    def cube_crops(self, frame: Frame) -> Float[Tensor, "B V 3 4"]:
        """P of every view for the points of the cubes."""
        return self.crops(frame.middle, frame.half[:, None, None] * frame.axes.mT, frame.half)


def _nearest(eyes: Float[Tensor, "B V 3"], rays: Float[Tensor, "B V 3"]) -> Float[Tensor, "B 3"]:
    """The points nearest to each object's rays; where they are parallel, near the cameras."""
    axes = torch.nn.functional.normalize(rays, dim=-1)
    across = across_axes(axes.flatten(0, 1)).view(*axes.shape, 3)
    count = axes.shape[1]
    A = across.sum(1) + DAMPING * count * torch.eye(3, device=eyes.device)
    return torch.linalg.solve(A, (across @ eyes[..., None]).sum(1)[..., 0] + DAMPING * eyes.sum(1))


def voxel_centers(side: int, device: torch.device | str = "cpu") -> Float[Tensor, "N 3"]:
    """Centers of side³ voxels of the cube, z fastest."""
    steps = (torch.arange(side, device=device) + 0.5) / side * 2 - 1
    return torch.cartesian_prod(steps, steps, steps)


def lookup(volumes: Float[Tensor, "B C s s s"], points: Float[Tensor, "B N 3"], outside: str) -> Tensor:
    """Trilinear values at points of [-1, 1]³; beyond it `zeros` or the `border`: [B, C, N]."""
    grid = points.flip(-1)[:, :, None, None]
    found = torch.nn.functional.grid_sample(volumes, grid, padding_mode=outside, align_corners=False)
    return found[..., 0, 0]


def projected(crops: Float[Tensor, "B V 3 4"], points: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor]:
    """Crop coordinates [B, V, N, 2] and depths [B, V, N] of points."""
    seen = points @ crops[..., :3].mT + crops[..., None, :, 3]
    depth = seen[..., 2]
    return seen[..., :2] / depth.clamp_min(1e-6)[..., None], depth


def sampled(images: Float[Tensor, "B V C R R"], places: Float[Tensor, "B V N 2"], mode: str = "bilinear") -> Tensor:
    """Values at crop coordinates, 0 beyond the crop: [B, V, C, N]."""
    found = torch.nn.functional.grid_sample(
        images.flatten(0, 1), places.flatten(0, 1)[:, None], mode=mode, align_corners=False
    )
    return found[:, :, 0].view(*images.shape[:3], -1)


@dataclass(frozen=True)
class Hits:
    """First points of solid volumes on the rays of square crops."""

    hit: Bool[Tensor, "B V R R"]
    depth: Float[Tensor, "B V R R"]
    """In the unit of the crops; that of the farthest sample where nothing is hit."""
    points: Float[Tensor, "B V R R 3"]
    """In the volume's own [-1, 1]³."""


def first_hits(
    volumes: Float[Tensor, "B 1 s s s"], crops: Float[Tensor, "B V 3 4"], side: int, steps: int, reach: Tensor
) -> Hits:
    """Marches the rays of side² pixels from `reach` [B] before the volume's middle to as far behind it."""
    pixels = (torch.arange(side, device=volumes.device) + 0.5) / side * 2 - 1
    v, u = torch.meshgrid(pixels, pixels, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1).view(-1, 3)
    share = (torch.arange(steps, device=volumes.device) + 0.5) / steps * 2 - 1
    parts = [_march(volumes, crops[:, view], rays, share, reach) for view in range(crops.shape[1])]
    hit, depth, points = (torch.stack(part, 1) for part in zip(*parts, strict=True))
    shape = (*crops.shape[:2], side, side)
    return Hits(hit.view(shape), depth.view(shape), points.view(*shape, 3))


def _march(volumes: Tensor, crop: Float[Tensor, "B 3 4"], rays: Tensor, share: Tensor, reach: Tensor) -> tuple:
    inverse = torch.linalg.inv(crop[..., :3])
    ahead, start = rays @ inverse.mT, -(inverse @ crop[..., 3:])[..., 0]
    depth = (crop[:, 2, 3, None] + reach[:, None] * share).clamp_min(NEAREST)
    points = start[:, None, None] + ahead[:, :, None] * depth[:, None, :, None]
    solid = lookup(volumes, points.flatten(1, 2), "zeros")[:, 0].view(points.shape[:3]) > 0.5
    first = torch.where(solid.any(-1), solid.int().argmax(-1), len(share) - 1)
    found = depth.gather(1, first)
    return solid.any(-1), found, start[:, None] + ahead * found[..., None]
