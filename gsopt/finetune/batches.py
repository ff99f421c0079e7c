"""Pairs made into batches: crops and scales, backgrounds, colors, noise, and conditions left out.

Two kinds of lesson share one network. In a *diffusion* lesson the noisy image is the truth under noise, as everywhere.
In a *repair* lesson it is the degraded render under noise, as it will be when the prior is asked in a run (Wu et al.
2025 train single-step fixers like this): had the network only seen the former, it would take x_t for the truth and give
the render back. The two cannot be confused, for the render stands beside x_t.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt.finetune.caption_tokens import Told
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.sds.noise import Latents, NoiseSchedule, add_noise
from gsopt.sds.priors.view_conditioned import STEPS, WARPED, Said, weighed

SIDE = 64
"""Of the images that are learned from, px."""
REPAIR_SHARE = 0.7
REPAIR_T = (20, 700)
"""Noise steps of repair lessons."""
CROP_SHARE = 0.6
"""Lessons that cut SIDE px out of the render; the others see all of it, reduced."""
WHITE_SHARE, BLACK_SHARE = 0.5, 0.2
"""Backgrounds; the others have a random color."""
USUAL_ERROR, LEAST_ERROR = 0.02, 0.004
"""Mean square, colors in [-1, 1]: of a render, and what is added to each so that perfect ones do not rule."""
WITHOUT_RENDER, WITHOUT_REFERENCES, WITHOUT_REFERENCE, WITHOUT_UNCERTAINTY = 0.05, 0.15, 0.1, 0.05


@dataclass(frozen=True)
class Batch:
    """What one step learns from."""

    x0: Latents
    x_t: Latents
    t: Int[Tensor, "B"]
    planes: Float[Tensor, "B C S S"]
    """See `condition_planes`."""
    said: Said
    weight: Float[Tensor, "B"]
    """Falls with the error of the render: what counts is by which share it is lowered, as decibels count."""


@dataclass(frozen=True)
class Images:
    """Pairs as floats on one background per row, colors 0..1."""

    truth: Float[Tensor, "B 3 S S"]
    render: Float[Tensor, "B 4 S S"]
    uncertainty: Float[Tensor, "B S S"]
    warped: Float[Tensor, "B K 4 S S"]

    @property
    def planes(self) -> Float[Tensor, "B C S S"]:
        """All conditions there are."""
        render = torch.cat([2 * self.render[:, :3] - 1, self.render[:, 3:]], 1)
        return torch.cat([render, self.uncertainty[:, None], weighed(self.warped).flatten(1, 2)], 1)


def on_background(pairs: Pairs, background: Float[Tensor, "B 3"]) -> Images:
    """Bytes to floats, composited; a render that is brighter than white is white, as a run shows it."""
    b = background[:, :, None, None]
    truth, render, u, warped = (getattr(pairs, item.name).float() / 255 for item in fields(Pairs))
    return Images(
        truth[:, :3] + (1 - truth[:, 3:]) * b,
        torch.cat([(render[:, :3] + (1 - render[:, 3:]) * b).clamp(0, 1), render[:, 3:]], 1),
        u,
        torch.cat([warped[:, :, :3] + (1 - warped[:, :, 3:4]) * b[:, None], warped[:, :, 4:]], 2),
    )


def draw(pairs: Pairs, count: int, noise: NoiseSchedule, random: torch.Generator, told: Told | None = None) -> Batch:
    """A batch of `count` lessons. What words are said about keeps its colors."""
    rows = torch.randint(len(pairs), (count,), generator=random)
    cut = Pairs(*(torch.cat(parts) for parts in zip(*(_cut(pairs, int(row), random) for row in rows), strict=True)))
    said = Said.nothing(count) if told is None else told.draw(rows, random)
    silent = said.tokens.flatten(1).any(1).logical_not()
    images = _recolored(on_background(cut, backgrounds(count, random)), silent, random)
    x0 = 2 * images.truth - 1
    repair = torch.rand(count, generator=random) < REPAIR_SHARE
    low, high = REPAIR_T
    t = torch.where(
        repair,
        torch.randint(low, high, (count,), generator=random),
        torch.randint(STEPS, (count,), generator=random),
    )
    clean = torch.where(repair[:, None, None, None], 2 * images.render[:, :3] - 1, x0)
    x_t = add_noise(clean, torch.randn(x0.shape, generator=random), noise.signal(t, x0))
    error = (2 * images.render[:, :3] - 1 - x0).square().mean((1, 2, 3))
    weight = USUAL_ERROR / (error + LEAST_ERROR)
    return Batch(x0, x_t, t, _forgotten(images.planes, repair, random), said, weight)


def backgrounds(count: int, random: torch.Generator) -> Float[Tensor, "B 3"]:
    kind = torch.rand(count, 1, generator=random)
    color = torch.rand(count, 3, generator=random)
    return torch.where(kind < WHITE_SHARE, 1.0, torch.where(kind < WHITE_SHARE + BLACK_SHARE, 0.0, color))


def _cut(pairs: Pairs, row: int, random: torch.Generator) -> tuple[Tensor, ...]:
    """One pair, SIDE px, turned and mirrored."""
    planes = torch.cat([tensor[row].flatten(0, -3) for tensor in vars(pairs).values() if tensor.dim() > 3]).float()
    planes = torch.cat([planes, pairs.uncertainty[row][None].float()])
    if float(torch.rand(1, generator=random)) < CROP_SHARE:
        planes = _crop(planes, random)
    else:
        planes = torch.nn.functional.adaptive_avg_pool2d(planes, SIDE)
    planes = planes.rot90(int(torch.randint(4, (1,), generator=random)), (1, 2))
    if int(torch.randint(2, (1,), generator=random)):
        planes = planes.flip(2)
    truth, render, warped, u = planes.split([4, 4, 5 * WARPED, 1])
    return truth[None], render[None], u, warped.view(1, WARPED, 5, SIDE, SIDE)


def _crop(planes: Float[Tensor, "P S S"], random: torch.Generator) -> Float[Tensor, "P s s"]:
    """Around a pixel where the truth or the render shows something."""
    size = planes.shape[-1]
    content = torch.nonzero((planes[3] + planes[7]).flatten() > 0)[:, 0]
    at = int(content[torch.randint(len(content), (1,), generator=random)]) if len(content) else size * size // 2
    top, left = (min(max(x - SIDE // 2, 0), size - SIDE) for x in divmod(at, size))
    return planes[:, top : top + SIDE, left : left + SIDE]


def _recolored(images: Images, rows: Bool[Tensor, "B"], random: torch.Generator) -> Images:
    """Channels of these rows exchanged and dimmed, the same in all images of a row."""
    count = len(images.truth)
    order = torch.where(rows[:, None], torch.rand(count, 3, generator=random).argsort(1), torch.arange(3))
    gain = 1 - 0.4 * rows[:, None, None, None] * torch.rand(count, 3, 1, 1, generator=random)
    each = torch.arange(count)[:, None]

    def of(colors: Tensor) -> Tensor:
        return colors[each, order] * gain

    warped = images.warped.clone()
    for k in range(WARPED):
        warped[:, k, :3] = of(warped[:, k, :3])
    render = torch.cat([of(images.render[:, :3]), images.render[:, 3:]], 1)
    return Images(of(images.truth), render, images.uncertainty, warped)


def _forgotten(planes: Float[Tensor, "B C S S"], repair: Tensor, random: torch.Generator) -> Float[Tensor, "B C S S"]:
    """Conditions left out at random, as `condition_planes` gives what is not known. Repair always knows its render."""
    count = len(planes)
    chance = torch.rand(count, 3 + WARPED, generator=random)
    planes = planes.clone()
    planes[(chance[:, 0] < WITHOUT_RENDER) & ~repair, :4] = 0
    planes[chance[:, 1] < WITHOUT_UNCERTAINTY, 4] = 1
    planes[chance[:, 2] < WITHOUT_REFERENCES, 5:] = 0
    for k in range(WARPED):
        planes[chance[:, 3 + k] < WITHOUT_REFERENCE, 5 + 4 * k : 9 + 4 * k] = 0
    return planes
