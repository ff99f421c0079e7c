"""What lessons say of their scenes: captions as tokens, and the scene's pictures as one image token."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.config.guidance import GuidanceConfig
from gsopt.finetune.pair_cache import Library
from gsopt.sds.conditioning import matched
from gsopt.sds.priors.protocol import Encoder
from gsopt.sds.priors.view_conditioned import Said

NOTHING_SAID, WITHOUT_TEXT, WITHOUT_IMAGES = 0.3, 0.25, 0.4
"""Shares of lessons: as by a run that has no encoder; the others may lack a caption (then the empty text is said) and
the image token."""
PICTURES = 8
"""Whose embeddings are averaged into an image token."""


@dataclass(frozen=True)
class Told:
    """Encoded once, before training."""

    scene: Int[Tensor, "M"]
    """Of every pair."""
    tokens: Float[Tensor, "n L D"]
    """Of all texts; the first is the empty one."""
    texts: tuple[tuple[int, ...], ...]
    """Per scene: rows of `tokens`."""
    images: Float[Tensor, "s D"]
    """One image token per scene."""

    def draw(self, rows: Int[Tensor, "B"], random: torch.Generator) -> Said:
        """What is said of these pairs, with parts left out at random."""
        chance = torch.rand(len(rows), 3, generator=random)
        scenes = self.scene[rows]
        chosen = [
            _one(self.texts[int(s)], random) if c >= WITHOUT_TEXT else 0
            for s, c in zip(scenes, chance[:, 0], strict=True)
        ]
        tokens = torch.cat([self.tokens[chosen], self.images[scenes][:, None]], 1)
        heard = torch.ones(tokens.shape[:2], dtype=torch.bool)
        heard[:, -1] = chance[:, 1] >= WITHOUT_IMAGES
        nothing = chance[:, 2] < NOTHING_SAID
        tokens[nothing], heard[nothing] = 0.0, True
        return Said(tokens, heard)

    def full(self, rows: Int[Tensor, "B"]) -> Said:
        """The caption and the image token."""
        scenes = self.scene[rows]
        first = [self.texts[int(s)][0] if self.texts[int(s)] else 0 for s in scenes]
        tokens = torch.cat([self.tokens[first], self.images[scenes][:, None]], 1)
        return Said(tokens, torch.ones(tokens.shape[:2], dtype=torch.bool))


def tell(encoder: Encoder, library: Library, said: Sequence[tuple[str, ...]]) -> Told:
    """Everything that lessons may say of the library's scenes."""
    texts = tuple(dict.fromkeys(["", *(text for own in said for text in own)]))
    tokens = encoder.texts(texts)
    embeddings = torch.stack([_embedding(encoder, library, index) for index in range(len(library.scenes))])
    images, _ = matched(embeddings, tokens, GuidanceConfig().image_weight)
    assert images is not None
    rows = tuple(tuple(texts.index(text) for text in own) for own in said)
    return Told(library.scene, tokens, rows, images)


def _embedding(encoder: Encoder, library: Library, scene: int) -> Float[Tensor, "E"]:
    """The mean of some of its pictures' embeddings, on white."""
    rows = torch.nonzero(library.scene == scene)[:, 0]
    rows = rows[torch.linspace(0, len(rows) - 1, min(PICTURES, len(rows))).round().long()]
    rgba = library.pairs.truth[rows].float() / 255
    embedded = encoder.images(rgba[:, :3] + 1 - rgba[:, 3:])
    assert embedded is not None
    return embedded.mean(0)


def _one(choices: tuple[int, ...], random: torch.Generator) -> int:
    """Any of them; the empty text where there is none."""
    return choices[int(torch.randint(len(choices), (1,), generator=random))] if choices else 0
