"""The forward process of a shape prior, and its inversion in a few deterministic steps (DDIM, Song et al. 2021).

The noise level s runs from 0, clean, to 1, all noise, with the share of the signal cos²(π s / 2).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.sds.noise import add_noise, eps_from, generator
from gsopt.shape_prior.evidence import INSIDE
from gsopt.shape_prior.network import VOLUME_CHANNELS, ShapeNetwork

STEPS = 8
"""Steps of a completion."""


def signal(level: Float[Tensor, "B"]) -> Float[Tensor, "B 1 1 1 1"]:
    """Share of the signal at each noise level."""
    return (level * (math.pi / 2)).cos().square().view(-1, 1, 1, 1, 1)


@torch.no_grad()
def completed(
    network: ShapeNetwork, known: Float[Tensor, "B C s s s"], words: Int[Tensor, "B L"], seed: int, steps: int = STEPS
) -> Float[Tensor, "B 4 s s s"]:
    """A clean volume for each row of evidence, empty outside the silhouettes; the same seed gives the same volume."""
    shape = (len(known), VOLUME_CHANNELS, *known.shape[2:])
    x = torch.randn(shape, generator=generator(seed, 0, 0, "completion")).to(known)
    x0 = x
    for step in range(steps):
        now, after = (torch.full((len(x),), 1 - i / steps, device=x.device) for i in (step, step + 1))
        x0 = network(x, now, known, words).clamp(-1, 1)
        a = signal(now)
        x = add_noise(x0, eps_from(x0, x, a), signal(after))
    outside = known[:, INSIDE, None] < 0.5
    empty = torch.tensor([-1.0, 0.0, 0.0, 0.0], device=x0.device).view(1, -1, 1, 1, 1)
    return torch.where(outside, empty, x0)
