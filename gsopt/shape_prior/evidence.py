"""The condition of a shape prior: what one to three photos say about every voxel of the cube around an object."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.init.inflation import STEEP
from gsopt.init.rounded_hull import RADIUS_RATIO
from gsopt.shape_prior.cube import first_hits, projected, sampled, voxel_centers

INSIDE, INFLATED, BEHIND, INSET, WEIGHT, COLOR = 0, 1, 2, 3, 4, slice(5, 8)
CHANNELS = 13
"""Inside all silhouettes; inflation's answer; distance behind the hull's first surface; to the outline; weight and
color of what is seen; right, ahead and up; sine of the first camera's height; number of photos."""
FADE = 6.0
"""Voxels behind the hull's first surface over which a photo's color counts less and less."""


def evidence(
    images: Float[Tensor, "B V 4 R R"], crops: Float[Tensor, "B V 3 4"], side: int
) -> Float[Tensor, "B C s s s"]:
    """The CHANNELS of side³ voxels. `images`: straight color times alpha, and alpha 0 or 1, each in its crop."""
    count, views = images.shape[:2]
    points = voxel_centers(side, images.device)
    places, depth = projected(crops, points)
    seen = sampled(images, places)
    within = (seen[:, :, 3] > 0.5) & (depth > 0)
    inside = within.all(1)
    hull = inside.view(count, 1, side, side, side).float()
    reach = torch.full((count,), math.sqrt(3), device=images.device)
    # A coarse march will do: the first surface of cones is smooth.
    front = first_hits(hull, crops, max(8, images.shape[-1] // 2), 2 * side, reach)
    first = sampled(front.depth[:, :, None], places, "nearest")[:, :, 0]
    behind = (depth - first).clamp(0, 2) * inside[:, None]
    inset, margin = _inflation(images[:, :, 3] > 0.5, crops, points, places, depth)
    answer = (0.5 + margin.amax(1) * side / 4).clamp(0, 1) * inside
    weight = seen[:, :, 3] * torch.exp(-behind * side / 2 / FADE)
    total = (weight[:, :, None] * seen[:, :, :3]).sum(1), (weight * seen[:, :, 3]).sum(1)[:, None]
    color = total[0] / total[1].clamp_min(1e-6) * (total[1] > 1e-6)
    height = -crops[:, 0, 2, 2] / crops[:, 0, 2, :3].norm(dim=-1)
    planes = [inside[:, None], answer[:, None], behind.amin(1)[:, None], inset.amin(1)[:, None] * inside[:, None]]
    planes += [(weight * within).amax(1)[:, None], color, points.T.expand(count, 3, -1)]
    planes += [height[:, None, None].expand(-1, 1, len(points)), torch.full_like(height, views - 2.0)[:, None, None]]
    planes[-1] = planes[-1].expand(-1, 1, len(points))
    return torch.cat([plane.to(images) for plane in planes], 1).view(count, CHANNELS, side, side, side)


def _inflation(
    solid: Bool[Tensor, "B V R R"], crops: Tensor, points: Tensor, places: Tensor, depth: Tensor
) -> tuple[Float[Tensor, "B V N"], Float[Tensor, "B V N"]]:
    """Distance of the pixels to the outline, and how deep the points lie in each view's inflated body by equation (1)
    of gsopt/init/inflation.py, both in units of half the cube."""
    size = solid.shape[-1]
    planes = torch.stack(disk_radii(solid.flatten(0, 1)), 1).view(*solid.shape[:2], 2, size, size)
    focal = torch.linalg.cross(crops[:, :, 0, :3], crops[:, :, 2, :3]).norm(dim=-1)
    scale = depth.clamp_min(0) / focal[..., None] * (2 / size)
    inset, width = (sampled(planes, places) * scale[:, :, None]).unbind(2)
    ahead = crops[:, :, 2, :3] / crops[:, :, 2, :3].norm(dim=-1, keepdim=True)
    level = torch.cat([ahead[..., :2], torch.zeros_like(ahead[..., :1])], -1)
    upward = torch.zeros_like(ahead)
    upward[..., 2] = 1
    steep = ahead[..., 2:].abs() > math.sin(STEEP)
    normal = torch.where(steep, upward, torch.nn.functional.normalize(level, dim=-1))
    away = (normal @ points.T).abs()
    return inset, (inset * (2 * width - inset)).clamp_min(0).sqrt() - away


def disk_radii(solid: Bool[Tensor, "N R R"]) -> tuple[Float[Tensor, "N R R"], Float[Tensor, "N R R"]]:
    """Distance of every pixel to the outline, and the radius of the largest disk of the silhouette that holds it, px.

    The same as `silhouette_distances` in gsopt/init/inflation.py for many silhouettes at once, on any device.
    """
    inset = distances(~solid) * solid
    width, radius = inset.clone(), inset.amax((1, 2), keepdim=True)
    for _ in range(math.ceil(math.log(solid.shape[-1] / 2, RADIUS_RATIO))):
        near = (distances(inset >= radius) <= radius) & solid & (radius > 1)
        width = torch.where(near, torch.maximum(width, radius), width)
        radius = radius / RADIUS_RATIO
    return inset, width


def distances(target: Bool[Tensor, "N R R"]) -> Float[Tensor, "N R R"]:
    """Distance of every pixel to the nearest true one, px; first along rows, then along columns."""
    side = target.shape[-1]
    steps = torch.arange(side, device=target.device)
    squared = ((steps[:, None] - steps) ** 2).float()
    along = torch.where(target[:, :, None], squared, 4.0 * side**2).amin(-1)
    return (along.mT[:, :, None] + squared).amin(-1).mT.sqrt()
