"""Trains a shape prior: x0 at every noise level by least squares, bfloat16 on a GPU only."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from gsopt.finetune.shapes.samples import Samples, drawn_samples
from gsopt.finetune.shapes.training_config import ShapeTrainingConfig
from gsopt.finetune.shapes.volumes import ShapeVolumes
from gsopt.finetune.trainer import AveragedTrainer
from gsopt.sds.noise import add_noise, generator
from gsopt.shape_prior.diffusion import signal
from gsopt.shape_prior.evidence import INSIDE
from gsopt.shape_prior.network import ShapeNetwork

COLOR_WEIGHT = 0.3
"""Weight of the error of a color channel, next to 1 for occupancy."""
OUTSIDE_WEIGHT = 0.1
"""Weight of a voxel that a silhouette leaves out, next to 1 for the others."""


class ShapeTrainer(AveragedTrainer[ShapeVolumes]):
    """Training of a shape prior."""

    config: ShapeTrainingConfig

    def __init__(self, network: ShapeNetwork, config: ShapeTrainingConfig, words: Int[Tensor, "N L"]) -> None:
        super().__init__(network, config)
        self.words = words

    def loss(self, data: ShapeVolumes) -> Tensor:
        config, device = self.config, data.sizes.device
        random = generator(config.seed, self.step, 0, "shapes")
        batch = drawn_samples(data, self.words, config.batch, config.side, config.image_side, random)
        level = torch.rand(config.batch, generator=random).to(device)
        # Drawn on the device, from a seed of this step: a million numbers for each sample.
        own = torch.Generator(device).manual_seed(int(torch.randint(1 << 62, (1,), generator=random)))
        eps = torch.randn(batch.x0.shape, generator=own, device=device)
        x_t = add_noise(batch.x0, eps, signal(level))
        # On the CPU bfloat16 would be wrong: the gradient of Conv3d's weights where a side of the input is 2.
        with torch.autocast("cuda", torch.bfloat16, enabled=device.type == "cuda"):
            x0_hat = self.unet(x_t, level, batch.known, batch.words)
        return squared_error(x0_hat.float(), batch)


def squared_error(x0_hat: Tensor, batch: Samples) -> Tensor:
    """Weighted mean squared error of volumes; where nothing is known every voxel counts."""
    error = (x0_hat - batch.x0).square()
    inside = batch.known[:, INSIDE, None]
    blind = ~batch.known.flatten(1).any(1)
    weight = torch.where(blind.view(-1, 1, 1, 1, 1), 1.0, OUTSIDE_WEIGHT + (1 - OUTSIDE_WEIGHT) * inside)
    each = error[:, :1] + COLOR_WEIGHT * error[:, 1:].sum(1, keepdim=True)
    return ((weight * each).sum((1, 2, 3, 4)) / weight.sum((1, 2, 3, 4))).mean()
