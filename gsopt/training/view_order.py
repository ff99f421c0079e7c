"""Explicit random numbers: one generator per purpose, and the order in which views are seen."""

from __future__ import annotations

import torch
from torch import Tensor

PURPOSES = ("views", "background", "dropout", "density")


def generators(seed: int) -> dict[str, torch.Generator]:
    """A CPU generator per purpose, so that what one draws does not move the others."""
    return {name: torch.Generator().manual_seed(seed * len(PURPOSES) + i) for i, name in enumerate(PURPOSES)}


class ViewOrder:
    """Every view once per epoch, shuffled anew for each (Kerbl et al. 2023), and among them some mirror images."""

    def __init__(self, views: int, generator: torch.Generator, images: int = 0, images_per_epoch: int = 0) -> None:
        """`images`, numbered on from the views, take turns: `images_per_epoch` of them, drawn anew for each epoch."""
        self._generator = generator
        self._views = views
        self._images, self._images_per_epoch = images, images_per_epoch
        self.order = torch.empty(0, dtype=torch.int64)
        """This epoch's views."""
        self.position = 0
        """Number of them that were seen."""

    def next(self) -> int:
        """The view of the next step."""
        if self.position >= len(self.order):
            self.order = self._epoch()
            self.position = 0
        self.position += 1
        return int(self.order[self.position - 1])

    def _epoch(self) -> Tensor:
        if self._images == 0:
            return torch.randperm(self._views, generator=self._generator)
        images = torch.randperm(self._images, generator=self._generator)[: self._images_per_epoch]
        rows = torch.cat([torch.arange(self._views), self._views + images])
        return rows[torch.randperm(len(rows), generator=self._generator)]

    def restore(self, order: Tensor, position: int) -> None:
        self.order, self.position = order, position
