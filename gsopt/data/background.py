"""The color behind transparent pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import DataConfig


@dataclass(frozen=True)
class Background:
    """A color, or one drawn anew for every step."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """RGB, 0..1; evaluations use it also where the steps draw theirs."""
    random: bool = False

    @staticmethod
    def of(config: DataConfig) -> Background:
        return Background(config.evaluation_background, config.background == "random")

    def constant(self) -> Float[Tensor, "3"] | None:
        """The color where it is the same in every step."""
        return None if self.random else self.fixed()

    def fixed(self) -> Float[Tensor, "3"]:
        return torch.tensor(self.color)

    def drawn(self, generator: torch.Generator) -> Float[Tensor, "3"]:
        """The color of a step; only a random background uses the generator."""
        return torch.rand(3, generator=generator) if self.random else self.fixed()
