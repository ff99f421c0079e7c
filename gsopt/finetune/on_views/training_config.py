"""Configuration of training Stable Diffusion on images, free of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsopt import check
from gsopt.errors import UsageError

LORA_RATE, FULL_RATE = 1e-4, 5e-6
MAX_VARIANTS_PER_IMAGE = 1024
"""Upper limit of --variants."""


@dataclass(frozen=True)
class ImageTrainingConfig:
    """Settings of the U-Net's training."""

    steps: int = 400
    batch: int = 4
    """Images per step, processed one after the other: memory does not grow with it."""
    lr: float | None = None
    """Learning rate, constant after 5 % of the steps; default 1e-4, with --full 5e-6."""
    rank: int = 8
    """Rank of the change of every attention layer (LoRA, Hu et al. 2022)."""
    full: bool = False
    """Train the whole U-Net instead of a low-rank change: 16 bytes of memory per weight, and a copy of it on disk."""
    save_every: int = 100
    sheet_every: int = 100
    """Steps between two sample sheets; 0 = none."""
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the frozen weights; trained weights are float32. auto: bfloat16 on a GPU, and for large models
    on a CPU with AVX-512, else float32."""

    def __post_init__(self) -> None:
        check.at_least("--steps", self.steps, 0, "A few hundred are usual.")
        check.within("--batch", self.batch, 1, 1024, "4 is usual.")
        check.within("--lr", self.rate, 0.0, 1.0, "The default is 1e-4, with --full 5e-6.")
        check.within("--rank", self.rank, 1, 1024, "4 to 16 are usual.")
        check.at_least("--save-every", self.save_every, 1, "The default is 100.")
        check.at_least("--sheet-every", self.sheet_every, 0, "0 makes no sheets.")
        check.one_of("--device", self.device, ("auto", "cpu", "cuda"))
        check.one_of("--dtype", self.dtype, ("auto", "float32", "bfloat16"))
        if self.full and self.dtype == "bfloat16":
            raise UsageError(
                "`--full` changes weights by less than bfloat16 can hold, got --dtype bfloat16. Drop --dtype, or "
                "train a LoRA: drop --full."
            )

    @property
    def rate(self) -> float:
        return self.lr if self.lr is not None else FULL_RATE if self.full else LORA_RATE

    def rate_at(self, step: int) -> float:
        """Returns the learning rate of a step, counted from 0."""
        return self.rate * min(1.0, (step + 1) / max(1, self.steps // 20))


@dataclass(frozen=True)
class ImagePreparation:
    """Preprocessing of the training images. Transparent parts become white."""

    size: int = 0
    """Side of the squares cut from the images, px; 0 = the model's native size."""
    flip: bool = False
    """Mirror every other variant. Not for objects with a distinct left and right."""
    crop: float = 0.0
    """Random crops of variants, smaller than the center square by up to this share of its side, 0 to 0.9."""
    jitter: float = 0.0
    """Largest relative change of brightness, contrast and saturation of variants, 0 to 0.5."""
    stretch: float = 0.0
    """Contrast stretch that clips this percentage of an image's pixels at either end: for X-rays and the like, 0.5 to
    2. Renders of a scene are not stretched: stretch its images, too, or leave this at 0."""
    variants: int = 8
    """Variants per image including the unmodified one; fewer when no setting above makes them differ."""

    def __post_init__(self) -> None:
        if self.size:
            check.within("--size", self.size, 8, 4096, "0 is the model's native size.")
        check.within("--crop", self.crop, 0.0, 0.9, "0 cuts out the center square; 0.2 is a start.")
        check.within("--jitter", self.jitter, 0.0, 0.5, "0 leaves colors alone; 0.1 is a start.")
        check.within("--stretch", self.stretch, 0.0, 25.0, "It is a percentage; 0 leaves the contrast alone.")
        check.within("--variants", self.variants, 1, MAX_VARIANTS_PER_IMAGE, "8 is usual.")

    @property
    def count(self) -> int:
        """Number of variants that differ."""
        return min(self.variants, MAX_VARIANTS_PER_IMAGE if self.crop or self.jitter else 2 if self.flip else 1)
