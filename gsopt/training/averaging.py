"""The mean of the Gaussians over the last steps of a run (Polyak & Juditsky 1992; Izmailov et al. 2018).

With few photos of a whole scene the learning rates never fall, since their noise keeps a run from fitting single photos
too well; the mean over the last steps keeps that and loses the noise of the last one.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from gsopt import check
from gsopt.gaussians import PARAMETERS, Gaussians

SHARE = 1 / 8
"""Share of the run that is averaged."""
EVERY = 10
"""Steps between two Gaussians that are averaged: each costs a pass over all numbers."""


class RunningAverage:
    """Mean of a run's Gaussians, each row beside its Gaussian; empty until the last `SHARE` of the steps."""

    def __init__(self, first: int) -> None:
        """`first`: the step after which Gaussians are averaged; none may be added from there on."""
        self._first = first
        self._mean: dict[str, Tensor] = {}
        self.count = 0
        """Number of Gaussians in the mean of each row."""

    def note(self, step: int, gaussians: Gaussians) -> None:
        """Takes a step's Gaussians into the mean, where it is due."""
        if step <= self._first or step % EVERY != 0:
            return
        self.count += 1
        for name, values in gaussians.items():
            if self.count == 1:
                self._mean[name] = values.clone()
            else:
                self._mean[name].lerp_(values, 1 / self.count)

    def select(self, rows: Bool[Tensor, "N"] | Int[Tensor, "M"]) -> None:
        """Follows a selection or another order of the Gaussians."""
        self._mean = {name: values[rows] for name, values in self._mean.items()}

    def of(self, gaussians: Gaussians) -> Gaussians:
        """Returns the mean, or the Gaussians themselves before there is one."""
        return Gaussians(**self._mean) if self.count > 0 else gaussians

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint: `count`, then the mean."""
        return {"count": torch.tensor(self.count), **self._mean}

    def restore(self, tensors: dict[str, Tensor], gaussians: Gaussians) -> None:
        """Inverse of `tensors`. Raises InputError for a mean that does not fit the Gaussians."""
        self.count = int(tensors["count"])
        self._mean = {name: tensors[name].to(gaussians.means.device) for name in PARAMETERS if self.count > 0}
        for name, values in gaussians.items():
            if self.count > 0:
                check.shape(f"average.{name}", self._mean[name], tuple(values.shape))
