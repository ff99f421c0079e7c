"""Text conditions of training examples: tokens of the captions and one image token per scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.config.guidance import GuidanceConfig
from gsopt.finetune.pair_cache import PairCache
from gsopt.sds.conditioning import rms_matched
from gsopt.sds.priors.protocol import Encoder
from gsopt.sds.priors.view_conditioned import TextTokens

WITHOUT_TOKENS, WITHOUT_TEXT, WITHOUT_IMAGES = 0.3, 0.25, 0.4
"""Shares of examples without any tokens (as in a run without encoder); of the others, shares with the empty text
instead of a caption, and without the image token."""
IMAGES_PER_SCENE = 8
"""Number of images whose embeddings are averaged into an image token."""


@dataclass(frozen=True)
class SceneCaptions:
    """Captions and image tokens of all scenes, encoded once before training."""

    scene: Int[Tensor, "M"]
    """Scene index of every pair."""
    tokens: Float[Tensor, "n L D"]
    """Tokens of all texts; the first text is empty."""
    texts: tuple[tuple[int, ...], ...]
    """Per scene: rows of `tokens`."""
    images: Float[Tensor, "s D"]
    """One image token per scene."""

    def sample(self, rows: Int[Tensor, "B"], random: torch.Generator) -> TextTokens:
        """Returns tokens for these pairs, with random dropout."""
        chance = torch.rand(len(rows), 3, generator=random)
        scenes = self.scene[rows]
        chosen = [
            _one(self.texts[int(s)], random) if c >= WITHOUT_TEXT else 0
            for s, c in zip(scenes, chance[:, 0], strict=True)
        ]
        tokens = torch.cat([self.tokens[chosen], self.images[scenes][:, None]], 1)
        mask = torch.ones(tokens.shape[:2], dtype=torch.bool)
        mask[:, -1] = chance[:, 1] >= WITHOUT_IMAGES
        nothing = chance[:, 2] < WITHOUT_TOKENS
        tokens[nothing], mask[nothing] = 0.0, True
        return TextTokens(tokens, mask)

    def complete(self, rows: Int[Tensor, "B"]) -> TextTokens:
        """Returns the first caption and the image token."""
        scenes = self.scene[rows]
        first = [self.texts[int(s)][0] if self.texts[int(s)] else 0 for s in scenes]
        tokens = torch.cat([self.tokens[first], self.images[scenes][:, None]], 1)
        return TextTokens(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool))


def encode_captions(encoder: Encoder, cache: PairCache, said: Sequence[tuple[str, ...]]) -> SceneCaptions:
    """Encodes all texts and images of the cached scenes."""
    texts = tuple(dict.fromkeys(["", *(text for own in said for text in own)]))
    tokens = encoder.texts(texts)
    embeddings = torch.stack([_embedding(encoder, cache, index) for index in range(len(cache.scenes))])
    images, _ = rms_matched(embeddings, tokens, GuidanceConfig().image_weight)
    assert images is not None
    rows = tuple(tuple(texts.index(text) for text in own) for own in said)
    return SceneCaptions(cache.scene, tokens, rows, images)


def _embedding(encoder: Encoder, cache: PairCache, scene: int) -> Float[Tensor, "E"]:
    """Returns the mean embedding of some images of the scene, on white."""
    rows = torch.nonzero(cache.scene == scene)[:, 0]
    rows = rows[torch.linspace(0, len(rows) - 1, min(IMAGES_PER_SCENE, len(rows))).round().long()]
    rgba = cache.pairs.truth[rows].float() / 255
    embedded = encoder.images(rgba[:, :3] + 1 - rgba[:, 3:])
    assert embedded is not None
    return embedded.mean(0)


def _one(choices: tuple[int, ...], random: torch.Generator) -> int:
    """Returns a random choice; row 0, the empty text, when there is none."""
    return choices[int(torch.randint(len(choices), (1,), generator=random))] if choices else 0
