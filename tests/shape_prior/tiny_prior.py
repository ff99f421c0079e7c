"""Small shape priors, untrained: they answer with the inflated silhouette."""

from __future__ import annotations

from pathlib import Path

import torch

from gsopt.shape_prior.folder import ShapePrior, write_card, write_weights
from gsopt.shape_prior.network import NetworkConfig, ShapeNetwork

CONFIG = NetworkConfig(32, (8, 16), 1)
WORDS = ("ball", "chair", "table")


def untrained(seed: int = 0, config: NetworkConfig = CONFIG) -> ShapePrior:
    torch.manual_seed(seed)
    network = ShapeNetwork(config, len(WORDS) + 1).eval().requires_grad_(False)
    return ShapePrior(network, config, WORDS, 48)


def write_prior(folder: Path, prior: ShapePrior | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_weights(folder, prior or untrained())
    write_card(folder, prior or untrained(), {})
    return folder
