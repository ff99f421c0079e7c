"""The color behind transparent pixels, and behind what no photo shows."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import BACKGROUNDS, DataConfig
from gsopt.data.scene import Scene

MAX_COLOR_VIEWS = 16
"""Input views whose colors are averaged, evenly spread."""


@dataclass(frozen=True)
class Background:
    """A color, or one drawn anew for every step."""

    color: tuple[float, float, float] = BACKGROUNDS["white"]
    """RGB, 0..1; evaluations use it also where the steps draw theirs."""
    random: bool = False

    @staticmethod
    def of(config: DataConfig, scene: Scene) -> Background:
        """The background of a run. `auto`: behind a scene without masks lies what no photo shows, and the mean color of
        the photos is nearest to it; white is behind an object."""
        if config.background == "auto" and not scene.has_alpha:
            return Background(mean_color(scene))
        return Background(BACKGROUNDS.get(config.background, BACKGROUNDS["white"]), config.background == "random")

    def constant(self) -> Float[Tensor, "3"] | None:
        """The color where it is the same in every step."""
        return None if self.random else self.fixed()

    def fixed(self) -> Float[Tensor, "3"]:
        return torch.tensor(self.color)

    def drawn(self, generator: torch.Generator) -> Float[Tensor, "3"]:
        """The color of a step; only a random background uses the generator."""
        return torch.rand(3, generator=generator) if self.random else self.fixed()


def mean_color(scene: Scene) -> tuple[float, float, float]:
    """The mean color of the input views, to a thousandth."""
    count = min(MAX_COLOR_VIEWS, len(scene.train))
    views = [scene.train[row * len(scene.train) // count] for row in range(count)]
    sums = [view.pixels()[..., :3].sum((0, 1), dtype=torch.int64) for view in views]
    pixels = sum(view.camera.width * view.camera.height for view in views)
    red, green, blue = (round(value / (255 * pixels), 3) for value in torch.stack(sums).sum(0).tolist())
    return red, green, blue
