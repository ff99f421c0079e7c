"""Connected parts of a mask."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int64
from torch import Tensor

SMALL_HOLE = 0.02
"""Share of the mask's area up to which a hole in it is filled; a cup's handle leaves a larger one."""


def cleaned(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """The largest connected part of a mask, without its small holes."""
    if not bool(mask.any()):
        return mask
    parts = labels(mask)
    sizes = torch.bincount(parts[mask])
    largest = parts == int(sizes.argmax())
    around = labels(~largest)
    filled = torch.bincount(around[~largest], minlength=int(around.max()) + 1) <= SMALL_HOLE * float(largest.sum())
    border = torch.cat([around[0], around[-1], around[:, 0], around[:, -1]])
    filled[border[border > 0]] = False
    return largest | ((around > 0) & filled[around])


def touched(mask: Bool[Tensor, "H W"], seeds: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """The connected parts of a mask (8 neighbors) that have a seed: these spread in it until nothing changes."""
    reached = mask & seeds
    while True:
        wide = torch.nn.functional.max_pool2d(reached[None, None].float(), 3, 1, 1)[0, 0].bool() & mask
        if torch.equal(wide, reached):
            return reached
        reached = wide


def labels(mask: Bool[Tensor, "H W"]) -> Int64[Tensor, "H W"]:
    """A number above 0 for each connected part (8 neighbors), 0 outside: the largest number of its pixels spreads until
    nothing changes."""
    numbers = (torch.arange(mask.numel(), dtype=torch.float64) + 1).view(mask.shape) * mask
    while True:
        wide = torch.nn.functional.max_pool2d(numbers[None, None], 3, 1, 1)[0, 0] * mask
        if torch.equal(wide, numbers):
            return torch.unique(numbers, return_inverse=True)[1] + int(bool(mask.all()))
        numbers = wide
