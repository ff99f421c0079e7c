"""Configuration of a shape prior's training, free of torch."""

from __future__ import annotations

from dataclasses import dataclass

from gsopt import check
from gsopt.errors import UsageError
from gsopt.finetune.training_config import TrainingConfig


@dataclass(frozen=True)
class ShapeTrainingConfig(TrainingConfig):
    """Settings of a shape prior's training."""

    steps: int = 40_000
    batch: int = 32
    lr: float = 3e-4
    """Peak learning rate; reached after 2 % of the steps, then a cosine down to 2 %."""
    save_every: int = 1000
    side: int = 64
    """Voxels along each side of the cube."""
    widths: tuple[int, ...] = (96, 128, 160, 192)
    """Channels of the network at each resolution, the finest first."""
    blocks: int = 2
    """Blocks of the network at each resolution, down and up."""
    image_side: int = 96
    """Side of the silhouettes' crops, px."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check.within("--image-side", self.image_side, 16, 256, "The default is 96.")
        if self.image_side % 2:
            raise UsageError(f"`--image-side` must be even, got {self.image_side}. Try {self.image_side + 1}.")
