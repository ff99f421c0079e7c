"""A picture of a library's shape, in its coarse colors."""

from __future__ import annotations

import math

import torch
from jaxtyping import UInt8
from torch import Tensor

from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.voxels import eroded
from gsopt.init.guessed_views import voxel_gaussians
from gsopt.raster.backend import Backend, RasterSettings
from gsopt.shape_library.entry import COLOR_SIDE, SIDE, Shape

PICTURE_SIDE = 160
AZIMUTH, ELEVATION = math.radians(-55), math.radians(25)
DISTANCE, FOCAL = 4.0, 3.2
"""The camera's distance from the box whose longest side is 1; focal length in sides of the picture."""
SPLAT_SCALE = 0.7
"""Standard deviation of the splats, voxels along the longest side."""


def picture(shape: Shape, backend: Backend) -> UInt8[Tensor, "S S 3"]:
    """The shape from the front, a little from the side and from above, on white."""
    occupied = torch.from_numpy(shape.occupied)
    cells = torch.nonzero(occupied & ~eroded(occupied))
    place = (cells + 0.5) / SIDE
    color = torch.from_numpy(shape.colors.copy())[tuple((place * COLOR_SIDE).long().T)]
    points = (place - 0.5) * torch.from_numpy(shape.sizes.copy())
    gaussians = voxel_gaussians(points, color.float() / 255, SPLAT_SCALE / SIDE).to(backend.device)
    colors = backend.forward(gaussians, _camera(), RasterSettings(sh_degree=0), torch.ones(3)).colors
    return (colors.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def _camera() -> Cameras:
    level = math.cos(ELEVATION)
    away = torch.tensor([level * math.cos(AZIMUTH), level * math.sin(AZIMUTH), math.sin(ELEVATION)])
    viewmats = look_at(DISTANCE * away[None], torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal, half = FOCAL * PICTURE_SIDE, PICTURE_SIDE / 2
    K = torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1.0]])
    return Cameras(viewmats, K[None], PICTURE_SIDE, PICTURE_SIDE)
