"""Colors of a photo without the rim of its silhouette, from which the sides of a body get theirs.

Pixels at the rim hold the background's light, and they are carried farthest: all of the body's flank projects there.
They are replaced by what the pixels within would become if they went on: averages over blocks that double in size until
one holds an inner pixel (push-pull, Gortler et al. 1996).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from gsopt.init.inflation import MAX_DISTANCE_SIDE, silhouette_distances
from gsopt.init.thumbnails import Thumbnail

RIM = 0.15
"""Width of the rim, as a share of the half width of the part of the silhouette that it bounds."""
LEAST_PIXELS = 1.5


def without_rim(photo: Thumbnail) -> Thumbnail:
    """The photo with the colors of its inner pixels continued to the rim and beyond; as it is where none is inner."""
    solid = photo.planes[3] > 127
    factor = -(-max(solid.shape) // MAX_DISTANCE_SIDE)
    distances = torch.stack(silhouette_distances(solid[factor // 2 :: factor, factor // 2 :: factor])) * factor
    inset, width = interpolate(distances[None], size=solid.shape, mode="bilinear", align_corners=False)[0]
    inner = solid & (inset > (RIM * width).clamp_min(LEAST_PIXELS))
    if not bool(inner.any()):
        return photo
    weight = inner.float()[None]
    planes = continued(photo.planes.float() * weight, weight)
    return replace(photo, planes=planes.round().clamp(0, 255).to(torch.uint8))


def continued(planes: Float[Tensor, "C H W"], weight: Float[Tensor, "1 H W"]) -> Float[Tensor, "C H W"]:
    """Weighted planes over their weight; where there is none, interpolated from blocks twice as large."""
    known = weight > 0
    if bool(known.all()):
        return planes / weight
    halves = [avg_pool2d(values, 2, ceil_mode=True) for values in (planes, weight)]
    coarse = continued(halves[0], halves[1])
    filled = interpolate(coarse[None], size=planes.shape[1:], mode="bilinear", align_corners=False)[0]
    return torch.where(known, planes / weight.clamp_min(1e-12), filled)
