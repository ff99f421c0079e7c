"""Configuration of a prior's training, free of torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsopt import check


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of the training of any network."""

    steps: int = 6000
    batch: int = 16
    lr: float = 4e-4
    """Peak learning rate; reached after 2 % of the steps, then a cosine down to 2 %."""
    weight_decay: float = 0.01
    ema: float = 0.999
    """Decay of the averaged weights, which the prior keeps; lower at first."""
    save_every: int = 200
    seed: int = 0

    def __post_init__(self) -> None:
        check.at_least("--steps", self.steps, 1, "A few thousand are a start.")
        check.at_least("--batch", self.batch, 1, "16 is usual.")
        check.within("--lr", self.lr, 0.0, 1.0, "The default is 4e-4.")

    def rate(self, step: int) -> float:
        """Returns the learning rate of a step, counted from 0."""
        warm = max(1, self.steps // 50)
        progress = min(1.0, max(0.0, (step - warm) / max(1, self.steps - warm)))
        return self.lr * min(1.0, (step + 1) / warm) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))


@dataclass(frozen=True)
class PriorTrainingConfig(TrainingConfig):
    """Settings of a view-conditioned prior's training."""

    clip_steps: int = 1000
    """Training steps of the CLIP for the scenes' captions, when they have captions and --base has no CLIP."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check.at_least("--clip-steps", self.clip_steps, 0, "0 trains none: the prior takes no text.")
