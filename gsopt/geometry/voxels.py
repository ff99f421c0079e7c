"""A box of cubic voxels, and neighbors in it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Grid:
    """Voxels that may belong to the object."""

    occupied: Bool[Tensor, "X Y Z"]
    low: Float[Tensor, "3"]
    """Corner of voxel (0, 0, 0)."""
    voxel: float
    """Edge, scene units."""

    def centers(self, cells: Bool[Tensor, "X Y Z"] | None = None) -> Float[Tensor, "M 3"]:
        """Centers of the true cells; of the occupied ones when not given."""
        return self.low + (torch.nonzero(self.occupied if cells is None else cells) + 0.5) * self.voxel

    def all_centers(self) -> Float[Tensor, "N 3"]:
        """Centers of all cells, in the order of `occupied`."""
        sides = enumerate(self.occupied.shape)
        return torch.cartesian_prod(*(self.low[axis] + (torch.arange(size) + 0.5) * self.voxel for axis, size in sides))

    def surface(self) -> Float[Tensor, "M 3"]:
        """Centers of the occupied voxels that have one of their 26 neighbors free."""
        return self.centers(self.occupied & ~eroded(self.occupied))


def dilated(cells: Bool[Tensor, "X Y Z"]) -> Bool[Tensor, "X Y Z"]:
    """With the 26 neighbors of every true voxel; one axis after the other."""
    for axis in range(3):
        wider, size = cells.clone(), cells.shape[axis]
        wider.narrow(axis, 1, size - 1).logical_or_(cells.narrow(axis, 0, size - 1))
        wider.narrow(axis, 0, size - 1).logical_or_(cells.narrow(axis, 1, size - 1))
        cells = wider
    return cells


def eroded(cells: Bool[Tensor, "X Y Z"]) -> Bool[Tensor, "X Y Z"]:
    """Without the voxels that have one of their 26 neighbors outside, the grid's border included."""
    return ~dilated(torch.nn.functional.pad(~cells, (1,) * 6, value=True))[1:-1, 1:-1, 1:-1]
