"""Selection of well-spread points."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def farthest_points(points: Float[Tensor, "N 3"], count: int) -> list[int]:
    """Rows of `count` well-spread points: the one closest to the mean, then always the one farthest from those chosen.

    Ties go to the lowest row (Gonzalez 1985).
    """
    to_mean = (points - points.mean(0)).norm(dim=1)
    chosen = [int(to_mean.numpy().argmin())]  # numpy: torch leaves open which of equals it returns
    nearest = (points - points[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        nearest[chosen] = -1  # cameras at one place must not be chosen twice
        row = int(nearest.numpy().argmax())
        chosen.append(row)
        nearest = torch.minimum(nearest, (points - points[row]).norm(dim=1))
    return chosen
