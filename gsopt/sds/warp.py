"""Warps input views into another camera by the render's depth: references aligned pixel by pixel.

A pixel of the camera is lifted to the rendered surface, projected into every input view, and takes that view's color.
The confidence is high when the input view sees the same surface:

    (1)  confidence = alpha alpha_ref exp(-((z - z_ref) / (DEPTH_SLACK z_ref))^2)

with z the surface point's depth in the input view and z_ref the depth rendered there. A network with aligned
colors as input need not learn correspondence, the slowest part of training view-conditioned priors.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.geometry.projection import inside, project

DEPTH_SLACK = 0.02


def warp(
    camera: Cameras,
    depth: Float[Tensor, "S S"],
    alpha: Float[Tensor, "S S"],
    images: Float[Tensor, "K 3 S S"],
    alphas: Float[Tensor, "K 1 S S"],
    depths: Float[Tensor, "K S S"],
    references: Cameras,
) -> Float[Tensor, "K 4 S S"]:
    """Returns the colors of K references warped into `camera`, and the confidence (1).

    Depths are expected z of the Gaussians, 0 on empty pixels; `images` 0..1 on a background.
    """
    points = lift(camera, depth).view(-1, 3)
    size = depth.shape
    rows = []
    for k in range(len(references)):
        column, row, z = project(references[k], points)
        shown = inside(references[k], column, row, z) & (depth.flatten() > 0)
        planes = torch.cat([images[k], alphas[k], depths[k][None]])
        found = _sampled(planes, torch.where(shown, column, 0.0), torch.where(shown, row, 0.0))
        apart = (z - found[4]) / (DEPTH_SLACK * found[4]).clamp_min(1e-12)
        confidence = torch.where(shown, alpha.flatten() * found[3] * torch.exp(-apart.square()), 0.0)
        rows.append(torch.cat([found[:3], confidence[None]]).view(4, *size))
    return torch.stack(rows)


def lift(camera: Cameras, depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """Returns world points at the pixel centers, at these z depths."""
    K, view = camera.Ks[0].to(depth), camera.viewmats[0].to(depth)
    height, width = depth.shape
    i, j = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (j - K[0, 2]) / K[0, 0] * depth, (i - K[1, 2]) / K[1, 1] * depth
    X, Y, Z = x - view[0, 3], y - view[1, 3], depth - view[2, 3]
    # Rᵀ(p - t), written out by coordinate so that the last bit does not depend on the blocking of a matrix product.
    return torch.stack([view[0, c] * X + view[1, c] * Y + view[2, c] * Z for c in range(3)], -1)


def _sampled(
    planes: Float[Tensor, "C H W"], column: Float[Tensor, "n"], row: Float[Tensor, "n"]
) -> Float[Tensor, "C n"]:
    """Samples bilinearly; repeats the border."""
    height, width = planes.shape[1:]
    grid = torch.stack([2 * column / width - 1, 2 * row / height - 1], -1)[None, None]
    return torch.nn.functional.grid_sample(planes[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
