"""Depth at which a pixel's transmittance falls to one half: the surface, where expected depth lies in the air.

The image is composited slab by slab, front to back: each slab is the splats between two planes across the viewing axis.
The slab in which the transmittance crosses one half is known exactly; its own expected depth is the depth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt._optional import require
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import inside, project
from gsopt.raster.backend import Backend, RasterSettings

SLABS = 32
"""Slabs between the nearest and the farthest point of the box."""


@dataclass(frozen=True)
class DepthView:
    """The picture of one camera, with depths."""

    camera: Cameras
    depths: Float[Tensor, "H W"]
    """Median depth along the viewing axis, scene units; infinite where more than half of the light passes."""
    gaps: Float[Tensor, "H W"]
    """Distance of the other pixels from the nearest with a depth, px; 0 where there is a depth."""
    colors: Float[Tensor, "H W 3"]
    """Premultiplied."""
    alphas: Float[Tensor, "H W"]

    def pixels(
        self, points: Float[Tensor, "M 3"]
    ) -> tuple[Int[Tensor, "M"], Int[Tensor, "M"], Float[Tensor, "M"], Bool[Tensor, "M"]]:
        """Column, row and depth of each point, and True where the image has it; elsewhere the pixel is the first."""
        column, row, depth = project(self.camera, points)
        shown = inside(self.camera, column, row, depth)
        x, y = (torch.where(shown, place, 0).long() for place in (column, row))
        return x.clamp(max=self.camera.width - 1), y.clamp(max=self.camera.height - 1), depth, shown


def depth_view(
    gaussians: Gaussians, camera: Cameras, backend: Backend, settings: RasterSettings, near: float, far: float
) -> DepthView:
    """Draw one camera's colors and median depths; `near` and `far` bound the depths of interest."""
    camera = camera.to(torch.float32)
    gaussians = gaussians.to(backend.device)
    frame = backend.forward(gaussians, camera, settings)
    left = torch.ones(camera.height, camera.width)
    found = torch.full_like(left, math.inf)
    flat = replace(gaussians, shN=gaussians.shN[:, :0].contiguous())
    for nearer, farther in slab_planes(max(near, settings.near_plane), far, settings.near_plane):
        planes = replace(settings, near_plane=nearer, far_plane=farther, sh_degree=0)
        slab = backend.forward(flat, camera, planes, depth=True)
        assert slab.depths is not None
        alphas, depths = slab.alphas.cpu(), slab.depths.cpu()
        behind = left * (1 - alphas)
        crossing = (left > 0.5) & (behind <= 0.5)
        found = torch.where(crossing, depths / alphas.clamp_min(1e-12), found)
        left = behind
    return DepthView(camera, found, outside_of(found.isfinite()), frame.colors.cpu(), frame.alphas.cpu())


def outside_of(solid: Bool[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Distance of each pixel center outside of the solid pixels, px; 0 inside, infinite without any."""
    if not bool(solid.any()):
        return torch.full(solid.shape, math.inf)
    distance = require("scipy.ndimage", "mesh", "A mesh").distance_transform_edt
    return torch.from_numpy(distance(~solid.numpy())).float().sub(0.5).clamp_min(0)


def slab_planes(near: float, far: float, nearest: float) -> Iterator[tuple[float, float]]:
    """(near_plane, far_plane) of each slab; a depth on a border falls into the slab behind it, and into no other."""
    borders = torch.linspace(near, max(far, near * (1 + 1e-6)), SLABS + 1)
    borders[0] = min(nearest, near)
    below = torch.nextafter(borders, torch.tensor(-math.inf)).clamp_min(0)
    for slab in range(SLABS):
        yield float(below[slab]), float(borders[slab + 1])
