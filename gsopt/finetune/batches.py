"""Makes training batches from pairs: random crops and scales, backgrounds, colors, noise, and condition dropout.

Two kinds of examples train one network. A *diffusion* example adds noise to the truth, as usual. A *repair* example
adds noise to the degraded render, as a guided run does (Wu et al. 2025 train single-step fixers like this): a network
trained on the former alone would take x_t for the truth and return the render. The render beside x_t tells the two
apart.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.finetune.caption_tokens import SceneCaptions
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.sds.noise import Latents, NoiseSchedule, add_noise
from gsopt.sds.priors.view_conditioned import MAX_REFERENCES, NOISE_STEPS, TextTokens, confidence_weighted

TRAINING_SIDE = 64
"""Side of the training images, px."""
REPAIR_SHARE = 0.7
REPAIR_T = (20, 700)
"""Range of the noise steps of repair examples."""
CROP_SHARE = 0.6
"""Share of examples that crop the render; the others use all of it, reduced."""
WHITE_SHARE, BLACK_SHARE = 0.5, 0.2
"""Shares of the backgrounds; the others have a random color."""
TYPICAL_ERROR, ERROR_OFFSET = 0.02, 0.004
"""Mean squared error of a render, colors in [-1, 1], and an offset that limits the weight of perfect renders."""
WITHOUT_RENDER, WITHOUT_REFERENCES, WITHOUT_REFERENCE, WITHOUT_UNCERTAINTY = 0.05, 0.15, 0.1, 0.05


@dataclass(frozen=True)
class Batch:
    """The training examples of one step."""

    x0: Latents
    x_t: Latents
    t: Int[Tensor, "B"]
    planes: Float[Tensor, "B C S S"]
    """See `condition_planes`."""
    said: TextTokens
    weight: Float[Tensor, "B"]
    """Falls with the render's error: the relative reduction of the error counts, as in decibels."""


@dataclass(frozen=True)
class CompositedPairs:
    """Pairs composited on one background per row, as floats, colors 0..1."""

    truth: Float[Tensor, "B 3 S S"]
    render: Float[Tensor, "B 4 S S"]
    uncertainty: Float[Tensor, "B S S"]
    warped: Float[Tensor, "B K 4 S S"]

    @property
    def planes(self) -> Float[Tensor, "B C S S"]:
        """All conditions."""
        render = torch.cat([2 * self.render[:, :3] - 1, self.render[:, 3:]], 1)
        return torch.cat([render, self.uncertainty[:, None], confidence_weighted(self.warped).flatten(1, 2)], 1)


def on_background(pairs: Pairs, background: Float[Tensor, "B 3"]) -> CompositedPairs:
    """Converts bytes to floats and composites; a render brighter than white is clamped, as in a run."""
    b = background[:, :, None, None]
    truth, render, u, warped = (getattr(pairs, item.name).float() / 255 for item in fields(Pairs))
    return CompositedPairs(
        truth[:, :3] + (1 - truth[:, 3:]) * b,
        torch.cat([(render[:, :3] + (1 - render[:, 3:]) * b).clamp(0, 1), render[:, 3:]], 1),
        u,
        torch.cat([warped[:, :, :3] + (1 - warped[:, :, 3:4]) * b[:, None], warped[:, :, 4:]], 2),
    )


def draw_batch(
    pairs: Pairs, count: int, noise: NoiseSchedule, random: torch.Generator, captions: SceneCaptions | None = None
) -> Batch:
    """Draws a batch of `count` examples. Rows with text tokens keep their colors, which the text may name."""
    rows = torch.randint(len(pairs), (count,), generator=random)
    cut = Pairs(*(torch.cat(parts) for parts in zip(*(_cut(pairs, int(row), random) for row in rows), strict=True)))
    said = TextTokens.empty(count) if captions is None else captions.sample(rows, random)
    uncaptioned = said.tokens.flatten(1).any(1).logical_not()
    images = _recolored(on_background(cut, backgrounds(count, random)), uncaptioned, random)
    x0 = 2 * images.truth - 1
    repair = torch.rand(count, generator=random) < REPAIR_SHARE
    low, high = REPAIR_T
    t = torch.where(
        repair,
        torch.randint(low, high, (count,), generator=random),
        torch.randint(NOISE_STEPS, (count,), generator=random),
    )
    clean = torch.where(repair[:, None, None, None], 2 * images.render[:, :3] - 1, x0)
    x_t = add_noise(clean, torch.randn(x0.shape, generator=random), noise.signal(t, x0))
    error = (2 * images.render[:, :3] - 1 - x0).square().mean((1, 2, 3))
    weight = TYPICAL_ERROR / (error + ERROR_OFFSET)
    return Batch(x0, x_t, t, _with_dropout(images.planes, repair, random), said, weight)


def backgrounds(count: int, random: torch.Generator) -> Float[Tensor, "B 3"]:
    kind = torch.rand(count, 1, generator=random)
    color = torch.rand(count, 3, generator=random)
    return torch.where(kind < WHITE_SHARE, 1.0, torch.where(kind < WHITE_SHARE + BLACK_SHARE, 0.0, color))


def _cut(pairs: Pairs, row: int, random: torch.Generator) -> tuple[Tensor, ...]:
    """Crops or reduces one pair to TRAINING_SIDE px, with a random rotation and reflection."""
    planes = torch.cat([tensor[row].flatten(0, -3) for tensor in vars(pairs).values() if tensor.dim() > 3]).float()
    planes = torch.cat([planes, pairs.uncertainty[row][None].float()])
    if float(torch.rand(1, generator=random)) < CROP_SHARE:
        planes = _crop(planes, random)
    else:
        planes = torch.nn.functional.adaptive_avg_pool2d(planes, TRAINING_SIDE)
    planes = planes.rot90(int(torch.randint(4, (1,), generator=random)), (1, 2))
    if int(torch.randint(2, (1,), generator=random)):
        planes = planes.flip(2)
    truth, render, warped, u = planes.split([4, 4, 5 * MAX_REFERENCES, 1])
    return truth[None], render[None], u, warped.view(1, MAX_REFERENCES, 5, TRAINING_SIDE, TRAINING_SIDE)


def _crop(planes: Float[Tensor, "P S S"], random: torch.Generator) -> Float[Tensor, "P s s"]:
    """Crops around a random pixel where the truth or the render is visible."""
    size = planes.shape[-1]
    content = torch.nonzero((planes[3] + planes[7]).flatten() > 0)[:, 0]
    at = int(content[torch.randint(len(content), (1,), generator=random)]) if len(content) else size * size // 2
    top, left = (min(max(x - TRAINING_SIDE // 2, 0), size - TRAINING_SIDE) for x in divmod(at, size))
    return planes[:, top : top + TRAINING_SIDE, left : left + TRAINING_SIDE]


def _recolored(images: CompositedPairs, rows: Bool[Tensor, "B"], random: torch.Generator) -> CompositedPairs:
    """Permutes and dims the channels of these rows, the same way in all images of a row."""
    count = len(images.truth)
    order = torch.where(rows[:, None], torch.rand(count, 3, generator=random).argsort(1), torch.arange(3))
    gain = 1 - 0.4 * rows[:, None, None, None] * torch.rand(count, 3, 1, 1, generator=random)
    each = torch.arange(count)[:, None]

    def of(colors: Tensor) -> Tensor:
        return colors[each, order] * gain

    warped = images.warped.clone()
    for k in range(MAX_REFERENCES):
        warped[:, k, :3] = of(warped[:, k, :3])
    render = torch.cat([of(images.render[:, :3]), images.render[:, 3:]], 1)
    return CompositedPairs(of(images.truth), render, images.uncertainty, warped)


def _with_dropout(
    planes: Float[Tensor, "B C S S"], repair: Tensor, random: torch.Generator
) -> Float[Tensor, "B C S S"]:
    """Drops conditions at random, encoded as `condition_planes` encodes absent ones. Repair rows keep their render."""
    count = len(planes)
    chance = torch.rand(count, 3 + MAX_REFERENCES, generator=random)
    planes = planes.clone()
    planes[(chance[:, 0] < WITHOUT_RENDER) & ~repair, :4] = 0
    planes[chance[:, 1] < WITHOUT_UNCERTAINTY, 4] = 1
    planes[chance[:, 2] < WITHOUT_REFERENCES, 5:] = 0
    for k in range(MAX_REFERENCES):
        planes[chance[:, 3 + k] < WITHOUT_REFERENCE, 5 + 4 * k : 9 + 4 * k] = 0
    return planes
