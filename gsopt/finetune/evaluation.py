"""Evaluates a prior on held-out scenes against the render and a warped reference: PSNR and a sample sheet."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from gsopt.finetune.batches import on_background
from gsopt.finetune.caption_tokens import SceneCaptions
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.metrics import capped_psnr
from gsopt.sds.noise import add_noise, generator
from gsopt.sds.priors.view_conditioned import TextTokens, cosine_schedule, predict

NOISE_STEPS_EVALUATED = (300, 500, 700, 900)
MAX_RENDERS = 48
"""Number of evaluated renders, evenly spread over the held-out scenes."""
SHEET_ROWS = 8
CONDITION_SUBSETS: dict[str, tuple[bool, bool, bool]] = {
    "nothing": (False, False, False),
    "words": (False, False, True),
    "render": (True, False, False),
    "references": (False, True, False),
    "render, references": (True, True, False),
    "render, references, words": (True, True, True),
}
"""Given conditions: the render (with its uncertainty), the references, the text tokens."""


@torch.no_grad()
def evaluate(unet: Any, pairs: Pairs, captions: SceneCaptions | None = None) -> dict[str, Any]:
    """Returns mean PSNR in dB on white over held-out renders: `render` and `reference` (the nearest one, warped; white
    where confidence is low) unchanged; `repair`, one step from the noisy render, per noise step, with all conditions;
    `x0`, one step from the noisy truth, per noise step and subset of conditions."""
    rows = _spread(pairs, MAX_RENDERS)
    chosen = pairs.rows(rows)
    said = None if captions is None else captions.complete(rows)
    white = torch.ones(len(chosen), 3)
    images = on_background(chosen, white)
    copied = images.warped[:, 0, :3] * images.warped[:, 0, 3:] + (1 - images.warped[:, 0, 3:])
    everything = images.planes
    repair = {
        str(t): psnr(_predicted(unet, images.render[:, :3], everything, t, said), images.truth)
        for t in (50, 100, 200, *NOISE_STEPS_EVALUATED)
    }
    x0 = {
        name: {
            str(t): psnr(
                _predicted(unet, images.truth, _known(everything, *known), t, said if words else None), images.truth
            )
            for t in NOISE_STEPS_EVALUATED
        }
        for name, (*known, words) in CONDITION_SUBSETS.items()
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


def _predicted(unet: Any, images: Tensor, planes: Tensor, t: int, said: TextTokens | None) -> Float[Tensor, "M 3 S S"]:
    """Returns x0_hat of noisy images, 0..1."""
    noise = cosine_schedule()
    rows = []
    for m in range(len(images)):
        x = 2 * images[m : m + 1] - 1
        eps = torch.randn(x.shape, generator=generator(0, t, m, "measure"))
        steps = torch.tensor([t])
        x_t = add_noise(x, eps, noise.signal(steps, x))
        own = None if said is None else TextTokens(said.tokens[m : m + 1], said.mask[m : m + 1])
        rows.append((predict(unet, x_t, steps, planes[m : m + 1], own) / 2 + 0.5).clamp(0, 1))
    return torch.cat(rows)


def psnr(images: Tensor, truth: Tensor) -> float:
    """Returns the mean PSNR over images, dB."""
    return round(float(capped_psnr(images.movedim(1, -1), truth.movedim(1, -1)).mean()), 3)


@torch.no_grad()
def sample_sheet(unet: Any, pairs: Pairs, captions: SceneCaptions | None = None) -> Image.Image:
    """Draws per row the truth, the render, its repairs from t = 100 and 300, and the nearest warped reference."""
    rows = _spread(pairs, SHEET_ROWS)
    chosen, said = pairs.rows(rows), None if captions is None else captions.complete(rows)
    images = on_background(chosen, torch.ones(len(chosen), 3))
    copied = images.warped[:, 0, :3] * images.warped[:, 0, 3:]
    repaired = [_predicted(unet, images.render[:, :3], images.planes, t, said) for t in (100, 300)]
    columns = [images.truth, images.render[:, :3], *repaired, copied]
    picture = torch.cat([torch.cat(list(column), 1) for column in columns], 2)
    return Image.fromarray((picture.permute(1, 2, 0) * 255).round().byte().numpy())


def _spread(pairs: Pairs, most: int) -> Int[Tensor, "m"]:
    return torch.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().long()
