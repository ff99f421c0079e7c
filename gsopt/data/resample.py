"""Exact area downscaling and premultiplied pixels: the arithmetic between a decoded file and a working image."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

ROWS = 256
"""Rows that are converted to floats at once."""


def downscaled_size(extent: int, factor: float) -> int:
    """round(extent / factor), halves up, at least 1: what the published images_2, images_4 folders have."""
    return max(1, math.floor(extent / factor + 0.5))


def premultiply(pixels: UInt8[Tensor, "H W C"]) -> Float[Tensor, "C H W"]:
    """0..255 floats, color times alpha where there is alpha."""
    planes = pixels.permute(2, 0, 1).float()
    if planes.shape[0] == 4:
        planes[:3] *= planes[3:] / 255
    return planes


def unpremultiply(planes: Float[Tensor, "C H W"]) -> UInt8[Tensor, "H W C"]:
    """Inverse of `premultiply`, rounded; color is 0 where alpha is 0."""
    if planes.shape[0] == 4:
        alpha = planes[3:]
        color = torch.where(alpha > 0, planes[:3] * 255 / alpha.clamp(min=1e-6), torch.zeros_like(planes[:3]))
        planes = torch.cat([color, alpha])
    return (planes + 0.5).clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous()


def downscaled(pixels: UInt8[Tensor, "H W C"], width: int, height: int) -> UInt8[Tensor, "h w C"]:
    """Area mean of a decoded image."""
    return unpremultiply(premultiplied_downscale(pixels, width, height))


def premultiplied_downscale(pixels: UInt8[Tensor, "H W C"], width: int, height: int) -> Float[Tensor, "C h w"]:
    """Area mean, premultiplied. Floats exist for a few rows at a time: a large photo does not fill the memory."""
    narrow = [_area_along(premultiply(rows), 2, width) for rows in pixels.split(ROWS)]
    return _area_along(torch.cat(narrow, dim=1), 1, height)


def area_downscale(planes: Float[Tensor, "C H W"], width: int, height: int) -> Float[Tensor, "C h w"]:
    """Mean over each target pixel's exact footprint, fractional edges included (separable box filter)."""
    return _area_along(_area_along(planes, 2, width), 1, height)


def _area_along(planes: Tensor, axis: int, size: int) -> Tensor:
    source = planes.shape[axis]
    if size > source:
        raise ValueError(f"an area filter cannot enlarge {source} to {size}")
    if size == source:
        return planes
    step = source / size
    starts = torch.arange(size, dtype=torch.float64) * source / size
    ends = torch.arange(1, size + 1, dtype=torch.float64) * source / size
    first = starts.floor().long()
    total = planes.new_zeros(*planes.shape[:axis], size, *planes.shape[axis + 1 :])
    reach = source // size if source % size == 0 else math.ceil(step) + 1  # source pixels that one target pixel touches
    for offset in range(reach):
        # The share of source pixel `first + offset` that lies inside the target pixel.
        index = first + offset
        overlap = (torch.minimum(ends, index + 1.0) - torch.maximum(starts, index.double())).clamp(min=0)
        weight = (overlap / step).float().view(*[-1 if a == axis else 1 for a in range(3)])
        total += planes.index_select(axis, index.clamp(max=source - 1).to(planes.device)) * weight.to(planes.device)
    return total


def sample(planes: Float[Tensor, "C H W"], column: Float[Tensor, "N"], row: Float[Tensor, "N"]) -> Float[Tensor, "C N"]:
    """Bilinear values at pixel coordinates (centers at +0.5); beyond the border the border's."""
    height, width = planes.shape[1:]
    grid = torch.stack([column * (2 / width) - 1, row * (2 / height) - 1], dim=-1)
    values = torch.nn.functional.grid_sample(
        planes[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return values[0, :, 0]
