"""Random numbers on the run's device, all from the generators that a checkpoint carries."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def normal(*shape: int, generator: torch.Generator, device: torch.device) -> Float[Tensor, "..."]:
    """Standard normal numbers."""
    return torch.randn(*shape, generator=beside(generator, device), device=device)


def uniform(*shape: int, generator: torch.Generator, device: torch.device) -> Float[Tensor, "..."]:
    """Uniform numbers from 0 to 1."""
    return torch.rand(*shape, generator=beside(generator, device), device=device)


def beside(generator: torch.Generator, device: torch.device) -> torch.Generator:
    """`generator` itself for its own device; elsewhere one that begins at a number that it draws, so that its state
    alone decides what comes."""
    if device.type == generator.device.type:
        return generator
    return torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=generator)))
