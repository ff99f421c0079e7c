"""The network of a shape prior: a U-Net in 3D that predicts a clean volume from a noisy one.

    (1)  x0_hat = base(evidence) + f(x_t, s, evidence, words)

A volume has four channels: occupancy in [-1, 1], and color in [-1, 1] times the share that is filled. The base is the
inflated silhouette in the colors seen, so that an untrained network answers with the rule. Noise level and words enter
every block by a scale and a shift (FiLM, Perez et al. 2018); patches of voxels are folded into channels for speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gsopt import check
from gsopt.errors import UsageError
from gsopt.shape_prior.evidence import CHANNELS, COLOR, INFLATED

VOLUME_CHANNELS = 4
PATCH = 2
"""Voxels along each side of a patch."""
GROUPS = 8
LEVEL_WIDTH = 64
"""Sines and cosines of the noise level."""
MAX_SIDE, MAX_WIDTH, MAX_LEVELS, MAX_BLOCKS = 128, 1024, 5, 6


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the network."""

    side: int = 64
    """Voxels along each side of the cube."""
    widths: tuple[int, ...] = (96, 128, 160, 192)
    """Channels at each resolution, the finest first."""
    blocks: int = 2
    """Blocks at each resolution, down and up."""

    def __post_init__(self) -> None:
        check.within("--side", self.side, 8, MAX_SIDE, "The default is 64.")
        check.within("--blocks", self.blocks, 1, MAX_BLOCKS, "The default is 2.")
        least = PATCH << len(self.widths)
        if not 1 <= len(self.widths) <= MAX_LEVELS or any(w % GROUPS or not 0 < w <= MAX_WIDTH for w in self.widths):
            raise UsageError(
                f"`--widths` must be 1 to {MAX_LEVELS} multiples of {GROUPS} up to {MAX_WIDTH}, got "
                f"{list(self.widths)}. The default is 96 128 160 192."
            )
        if self.side % (least // 2):
            raise UsageError(
                f"`--side` must be a multiple of {least // 2} for {len(self.widths)} widths, got {self.side}. Try 64."
            )


class Block(nn.Module):
    """Two convolutions beside a shortcut, scaled and shifted by the condition in between."""

    def __init__(self, before: int, after: int, condition: int) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.GroupNorm(GROUPS, before), nn.SiLU(), nn.Conv3d(before, after, 3, padding=1))
        self.film = nn.Linear(condition, 2 * after)
        self.norm, self.second = nn.GroupNorm(GROUPS, after), nn.Conv3d(after, after, 3, padding=1)
        self.shortcut = nn.Conv3d(before, after, 1) if before != after else nn.Identity()
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor, condition: Float[Tensor, "B E"]) -> Tensor:
        scale, shift = self.film(condition)[..., None, None, None].chunk(2, 1)
        inner = torch.nn.functional.silu(self.norm(self.first(x)) * (1 + scale) + shift)
        return self.shortcut(x) + self.second(inner)


class Blocks(nn.Module):
    """Blocks one after the other."""

    def __init__(self, before: int, after: int, condition: int, count: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(after if i else before, after, condition) for i in range(count))

    def forward(self, x: Tensor, condition: Float[Tensor, "B E"]) -> Tensor:
        for block in self.blocks:
            x = block(x, condition)
        return x


class ShapeNetwork(nn.Module):
    """Equation (1)."""

    def __init__(self, config: NetworkConfig, words: int) -> None:
        """`words`: size of the vocabulary, whose word 0 is no word."""
        super().__init__()
        widths, condition = config.widths, 2 * config.widths[-1]
        self.words = nn.Embedding(words, condition, padding_idx=0)
        self.level = nn.Sequential(nn.Linear(LEVEL_WIDTH, condition), nn.SiLU(), nn.Linear(condition, condition))
        self.enter = nn.Conv3d((VOLUME_CHANNELS + CHANNELS) * PATCH**3, widths[0], 3, padding=1)
        self.down, self.shrink, self.up, self.grow = (nn.ModuleList() for _ in range(4))
        for here, below in zip(widths, (*widths[1:], 0), strict=True):
            self.down.append(Blocks(here, here, condition, config.blocks))
            if below:
                self.shrink.append(nn.Conv3d(here, below, 3, stride=2, padding=1))
                self.grow.append(nn.Conv3d(below, here, 3, padding=1))
                self.up.append(Blocks(2 * here, here, condition, config.blocks))
        last = nn.Conv3d(widths[0], VOLUME_CHANNELS * PATCH**3, 3, padding=1)
        self.leave = nn.Sequential(nn.GroupNorm(GROUPS, widths[0]), nn.SiLU(), last)
        nn.init.zeros_(last.weight)
        if last.bias is not None:
            nn.init.zeros_(last.bias)

    def forward(
        self,
        x_t: Float[Tensor, "B 4 s s s"],
        level: Float[Tensor, "B"],
        known: Float[Tensor, "B C s s s"],
        words: Int[Tensor, "B L"],
    ) -> Float[Tensor, "B 4 s s s"]:
        said = self.words(words).sum(1) / (words > 0).sum(1, keepdim=True).clamp_min(1)
        condition = torch.nn.functional.silu(self.level(_waves(level)) + said)
        x = self.enter(folded(torch.cat([x_t, known], 1)))
        kept = []
        for i, blocks in enumerate(self.down):
            x = blocks(x, condition)
            if i < len(self.shrink):
                kept.append(x)
                x = self.shrink[i](x)
        for i in reversed(range(len(kept))):
            x = self.grow[i](torch.nn.functional.interpolate(x, scale_factor=2.0))
            x = self.up[i](torch.cat([x, kept[i]], 1), condition)
        return base(known) + unfolded(self.leave(x)).float()


def base(known: Float[Tensor, "B C s s s"]) -> Float[Tensor, "B 4 s s s"]:
    """The inflated silhouette in the colors seen."""
    filled = known[:, INFLATED, None]
    return torch.cat([2 * filled - 1, filled * (2 * known[:, COLOR] - 1)], 1)


def folded(x: Float[Tensor, "B C s s s"]) -> Tensor:
    """Patches as channels."""
    count, channels, side = x.shape[:3]
    split = x.view(count, channels, *(side // PATCH, PATCH) * 3)
    return split.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(count, channels * PATCH**3, *(side // PATCH,) * 3)


def unfolded(x: Tensor) -> Float[Tensor, "B C s s s"]:
    """Inverse of `folded`."""
    count, channels, side = x.shape[0], x.shape[1] // PATCH**3, x.shape[2]
    split = x.view(count, channels, PATCH, PATCH, PATCH, side, side, side)
    return split.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(count, channels, *(side * PATCH,) * 3)


def _waves(level: Float[Tensor, "B"]) -> Float[Tensor, "B E"]:
    rates = torch.exp(torch.arange(LEVEL_WIDTH // 2, device=level.device) * (math.log(1000.0) / (LEVEL_WIDTH // 2)))
    angles = level[:, None] * rates
    return torch.cat([angles.sin(), angles.cos()], 1)
