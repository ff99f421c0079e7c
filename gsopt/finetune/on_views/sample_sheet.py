"""Sample sheets of the model in training: denoised images and samples from pure noise."""

from __future__ import annotations

import torch
from PIL import Image
from torch import Tensor

from gsopt.finetune.on_views.trainer import ImageTrainer
from gsopt.sds import policies
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import Condition, Images, Pair, Scale

SHEET_ROWS = 3
NOISE_SHARE = 0.6
"""Noise level of the middle column, as a share of the process."""
SAMPLING_STEPS = 8
"""DDIM steps of the last column: a recognizable image at an acceptable time on a CPU."""
MAX_SIDE = 256
"""Largest side of the displayed images, px."""


@torch.no_grad()
def sample_sheet(trainer: ImageTrainer) -> Image.Image:
    """Draws per row an image through the autoencoder, its one-step denoising, and a sample from pure noise."""
    columns: list[list[Tensor]] = [[], [], []]
    examples, schedule = trainer.examples, trainer.prior.schedule
    for row in range(min(SHEET_ROWS, len(examples.latents))):
        z = examples.latents[row, 0][None]
        tokens = None if examples.tokens is None else examples.tokens[int(examples.said[row])]
        random = generator(0, row, 0, "sheet")
        eps = torch.randn(z.shape, generator=random)
        for column, (share, steps) in zip(columns[1:], ((NOISE_SHARE, 1), (1.0, SAMPLING_STEPS)), strict=True):
            same = Condition(tokens=tokens)
            look = policies.NoiseSample(schedule.step(share), eps, Pair(same, same), Scale())
            start = z if share < 1 else torch.zeros_like(z)
            column.append(_shown(trainer, policies.denoised(trainer.prior, start, look, steps)))
        columns[0].append(_shown(trainer, z))
    image = torch.cat([torch.cat(column, 1) for column in columns], 2)
    return Image.fromarray((image.permute(1, 2, 0) * 255).round().byte().numpy())


def _shown(trainer: ImageTrainer, z: Tensor) -> Tensor:
    images: Images = trainer.prior.decode(z)
    side = min(images.shape[-1], MAX_SIDE)
    small = torch.nn.functional.interpolate(images, (side, side), mode="bilinear", antialias=True)
    return small[0].clamp(0, 1)
