"""Reference images from prompts, by the text-to-image pipeline of a Stable Diffusion prior.

They show what the model takes the words for, not the object: nothing uses them before the expert has accepted them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsopt import check
from gsopt._optional import require
from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import UsageError
from gsopt.events import Report, write_atomic
from gsopt.llm_prompts.schema import MOST_IMAGES, Picture, Prompt

if TYPE_CHECKING:
    from PIL import Image

    from gsopt.sds.priors.stable_diffusion import DiffusersPrior

MOST_STEPS = 1000
PAGE = "index.html"


@dataclass(frozen=True)
class Drawing:
    """How pictures are made."""

    count: int
    """K: one picture per prompt, in turn, each with a seed of its own."""
    seed: int = 0
    steps: int = 25
    guidance_scale: float = 7.5

    def __post_init__(self) -> None:
        check.within("--images-from-prompts", self.count, 0, MOST_IMAGES, "4 is usual, 0 makes none.")
        check.within("--image-steps", self.steps, 1, MOST_STEPS, "25 is the default.")


def cannot_draw(prior: str) -> str | None:
    """Why this prior makes no pictures from words; None where nothing speaks against it. No torch."""
    if prior in ("auto", "embedded"):
        return (
            "the embedded prior repairs views of a scene and makes no pictures from words alone; name a Stable "
            "Diffusion model: --prior sd21 or a diffusers folder"
        )
    return None


def illustrate(
    prior_name: str, prompts: Sequence[Prompt], drawing: Drawing, folder: Path, report: Report
) -> tuple[tuple[Picture, ...], str | None]:
    """Pictures written to `folder` (none accepted), or the reason why this prior makes none.

    Raises InputError for a prior that is missing or broken, UsageError where there is nothing to draw.
    """
    reason = cannot_draw(prior_name)
    if reason is not None:
        return (), reason
    wanted = [prompt for prompt in prompts if prompt.polarity == "positive" and prompt.weight > 0]
    if not wanted:
        raise UsageError("`--images-from-prompts` needs a positive prompt, got none. Write one first.")
    prior, reason = _open(prior_name)
    if prior is None:
        return (), reason
    negative = ", ".join(p.text for p in prompts if p.polarity == "negative" and p.weight > 0)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    pipeline = _pipeline(prior)
    for number in range(drawing.count):
        prompt = wanted[number % len(wanted)]
        report(f"picture {number + 1} of {drawing.count}: {prompt.text}")
        image = _draw(pipeline, prior.size, prompt, negative, drawing, number)
        name = _free_name(folder)
        write_atomic(folder / name, _png(image))
        pictures.append(Picture(f"{folder.name}/{name}", prompt.text, prior.folder.name[-200:]))
    write_atomic(folder / PAGE, contact_sheet(pictures).encode())
    return tuple(pictures), None


def contact_sheet(pictures: Sequence[Picture]) -> str:
    """A page that shows the pictures with their prompts; it lies beside them and loads nothing else."""
    figures = "".join(
        f'<figure><img src="{escape(Path(picture.file).name)}" alt="" width="320"><figcaption>'
        f"{escape(Path(picture.file).name)}: {escape(picture.prompt)}</figcaption></figure>"
        for picture in pictures
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; img-src 'self' file:; style-src 'unsafe-inline'\"><title>Pictures from prompts"
        "</title><style>body{font:15px system-ui;margin:24px}figure{display:inline-block;width:320px;margin:8px;"
        "vertical-align:top}</style></head><body><h1>Pictures from prompts</h1><p>Made by a model. They guide nothing "
        f"until they are accepted: gsopt prompts review FILE.</p>{figures}</body></html>\n"
    )


def _open(name: str) -> tuple[DiffusersPrior | None, str | None]:
    from gsopt.sds.load_prior import open_prior
    from gsopt.sds.priors.stable_diffusion import DiffusersPrior

    prior = open_prior(name, GuidanceConfig(prior=name))
    if not isinstance(prior, DiffusersPrior) or not prior.folder.takes_text:
        return (
            None,
            f"the prior {name} takes no words; name a Stable Diffusion model: --prior sd21 or a diffusers folder",
        )
    if prior.class_embedding_width is not None:
        return (
            None,
            f"the prior {name} wants an image beside the words (unCLIP); name a text-to-image model: --prior sd21",
        )
    return prior, None


def _pipeline(prior: DiffusersPrior) -> Any:
    """diffusers' own pipeline, of parts that were checked one by one: model_index.json never names code to run."""
    from gsopt.sds.priors import clip

    diffusers = require("diffusers", "sds", "Pictures from prompts")
    path = prior.folder.path
    tower = clip.load_text_tower(path / "tokenizer", path / "text_encoder", prior.dtype)
    pipeline = diffusers.StableDiffusionPipeline(
        vae=prior.vae,
        text_encoder=tower.model.to(prior.device),
        tokenizer=tower.tokenizer,
        unet=prior.unet,
        scheduler=diffusers.DDIMScheduler.from_config(prior.folder.scheduler),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def _draw(pipeline: Any, size: int, prompt: Prompt, negative: str, drawing: Drawing, number: int) -> Image.Image:
    """One picture; same seed, same picture."""
    import torch

    from gsopt.sds.conditioning import worded

    image: Image.Image = pipeline(
        prompt=worded(prompt, "" if prompt.view == "all" else prompt.view),
        negative_prompt=negative or None,
        height=size,
        width=size,
        num_inference_steps=drawing.steps,
        guidance_scale=drawing.guidance_scale,
        generator=torch.Generator("cpu").manual_seed(drawing.seed + number),
    ).images[0]
    return image


def _free_name(folder: Path) -> str:
    """The first number that is not taken: pictures of an earlier call are never overwritten."""
    return next(name for n in range(1, 10_000) if not (folder / (name := f"{n:03d}.png")).exists())


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.convert("RGB").save(buffer, format="PNG")
    return buffer.getvalue()
