"""Sample sheets: what the model in training makes of its images' noise, and of nothing but noise."""

from __future__ import annotations

import torch
from PIL import Image
from torch import Tensor

from gsopt.finetune.on_views.trainer import Training
from gsopt.sds import policies
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import Condition, Images, Pair, Scale

SHOWN = 3
SHARE = 0.6
"""Noise of the middle column, as a share of the process."""
STEPS = 8
"""DDIM steps of the last column: enough to judge by, few enough to wait for on a CPU."""
LARGEST = 256
"""Side of the pictures, px."""


@torch.no_grad()
def sheet(training: Training) -> Image.Image:
    """Per row: an image through the autoencoder, one step from its noise, and a sample from pure noise."""
    columns: list[list[Tensor]] = [[], [], []]
    lessons, schedule = training.lessons, training.prior.schedule
    for row in range(min(SHOWN, len(lessons.latents))):
        z = lessons.latents[row, 0][None]
        tokens = None if lessons.tokens is None else lessons.tokens[int(lessons.said[row])]
        random = generator(0, row, 0, "sheet")
        eps = torch.randn(z.shape, generator=random)
        for column, (share, steps) in zip(columns[1:], ((SHARE, 1), (1.0, STEPS)), strict=True):
            same = Condition(tokens=tokens)
            look = policies.NoiseSample(schedule.step(share), eps, Pair(same, same), Scale())
            start = z if share < 1 else torch.zeros_like(z)
            column.append(_shown(training, policies.denoised(training.prior, start, look, steps)))
        columns[0].append(_shown(training, z))
    picture = torch.cat([torch.cat(column, 1) for column in columns], 2)
    return Image.fromarray((picture.permute(1, 2, 0) * 255).round().byte().numpy())


def _shown(training: Training, z: Tensor) -> Tensor:
    images: Images = training.prior.decode(z)
    side = min(images.shape[-1], LARGEST)
    small = torch.nn.functional.interpolate(images, (side, side), mode="bilinear", antialias=True)
    return small[0].clamp(0, 1)
