"""How good a prior is on scenes it never saw, beside what the render and a copied reference give: numbers, a sheet."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from gsopt.finetune.batches import on_background
from gsopt.finetune.caption_tokens import Told
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.metrics import capped_psnr
from gsopt.sds.noise import add_noise, generator
from gsopt.sds.priors.view_conditioned import Said, cosine_schedule, predict

TIMES = (300, 500, 700, 900)
MOST = 48
"""Renders that are measured, evenly spread over the held-out scenes."""
SHOWN = 8
SUBSETS: dict[str, tuple[bool, bool, bool]] = {
    "nothing": (False, False, False),
    "words": (False, False, True),
    "render": (True, False, False),
    "references": (False, True, False),
    "render, references": (True, True, False),
    "render, references, words": (True, True, True),
}
"""Whether the render (with its uncertainty), the references, and what can be said of the scene are known."""


@torch.no_grad()
def measure(unet: Any, pairs: Pairs, told: Told | None = None) -> dict[str, Any]:
    """Mean PSNR in dB on white, over held-out renders: `render` and `reference` (the nearest one, carried over; white
    where it is not trusted) as they are; `repair`, one step from the noisy render, per noise step, everything known;
    `x0`, one step from the noisy truth, per noise step and subset of conditions."""
    rows = _spread(pairs, MOST)
    chosen = pairs.rows(rows)
    said = None if told is None else told.full(rows)
    white = torch.ones(len(chosen), 3)
    images = on_background(chosen, white)
    copied = images.warped[:, 0, :3] * images.warped[:, 0, 3:] + (1 - images.warped[:, 0, 3:])
    everything = images.planes
    repair = {
        str(t): psnr(_asked(unet, images.render[:, :3], everything, t, said), images.truth)
        for t in (50, 100, 200, *TIMES)
    }
    x0 = {
        name: {
            str(t): psnr(
                _asked(unet, images.truth, _known(everything, *known), t, said if words else None), images.truth
            )
            for t in TIMES
        }
        for name, (*known, words) in SUBSETS.items()
        if said is not None or not words
    }
    return {
        "renders": len(chosen),
        "render": psnr(images.render[:, :3], images.truth),
        "reference": psnr(copied, images.truth),
        "repair": repair,
        "x0": x0,
    }


def _known(planes: Float[Tensor, "M C S S"], render: bool, references: bool) -> Float[Tensor, "M C S S"]:
    planes = planes.clone()
    if not render:
        planes[:, :4], planes[:, 4] = 0, 1
    if not references:
        planes[:, 5:] = 0
    return planes


def _asked(unet: Any, images: Tensor, planes: Tensor, t: int, said: Said | None) -> Float[Tensor, "M 3 S S"]:
    """x0_hat of noisy images, 0..1."""
    noise = cosine_schedule()
    rows = []
    for m in range(len(images)):
        x = 2 * images[m : m + 1] - 1
        eps = torch.randn(x.shape, generator=generator(0, t, m, "measure"))
        steps = torch.tensor([t])
        x_t = add_noise(x, eps, noise.signal(steps, x))
        own = None if said is None else Said(said.tokens[m : m + 1], said.heard[m : m + 1])
        rows.append((predict(unet, x_t, steps, planes[m : m + 1], own) / 2 + 0.5).clamp(0, 1))
    return torch.cat(rows)


def psnr(images: Tensor, truth: Tensor) -> float:
    """Mean over images, dB."""
    return round(float(capped_psnr(images.movedim(1, -1), truth.movedim(1, -1)).mean()), 3)


@torch.no_grad()
def sheet(unet: Any, pairs: Pairs, told: Told | None = None) -> Image.Image:
    """Per row: the truth, the render, its repair at t = 100 and 300, and the nearest reference carried over."""
    rows = _spread(pairs, SHOWN)
    chosen, said = pairs.rows(rows), None if told is None else told.full(rows)
    images = on_background(chosen, torch.ones(len(chosen), 3))
    copied = images.warped[:, 0, :3] * images.warped[:, 0, 3:]
    repaired = [_asked(unet, images.render[:, :3], images.planes, t, said) for t in (100, 300)]
    columns = [images.truth, images.render[:, :3], *repaired, copied]
    picture = torch.cat([torch.cat(list(column), 1) for column in columns], 2)
    return Image.fromarray((picture.permute(1, 2, 0) * 255).round().byte().numpy())


def _spread(pairs: Pairs, most: int) -> Int[Tensor, "m"]:
    return torch.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().long()
