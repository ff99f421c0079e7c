"""Reference images from prompts, by the text-to-image pipeline of a Stable Diffusion prior.

They show the model's reading of the prompts, not the object: guidance uses only those that the expert accepted.
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
from gsopt.events import Report, encoded, write_atomic
from gsopt.sds.prompts import MAX_IMAGES, Prompt, ReferenceImage

if TYPE_CHECKING:
    from PIL import Image

    from gsopt.sds.priors.stable_diffusion import DiffusersPrior

MAX_STEPS = 1000
PAGE = "index.html"


@dataclass(frozen=True)
class ImageSettings:
    """Settings of the image generation."""

    count: int
    """Number of images, for the prompts in turn, each with its own seed."""
    seed: int = 0
    steps: int = 25
    guidance_scale: float = 7.5

    def __post_init__(self) -> None:
        check.within("--images-from-prompts", self.count, 0, MAX_IMAGES, "4 is usual, 0 makes none.")
        check.within("--image-steps", self.steps, 1, MAX_STEPS, "25 is the default.")


def no_images_reason(prior: str) -> str | None:
    """Returns the reason why this prior generates no images, or `None`. No torch."""
    if prior in ("auto", "embedded"):
        return (
            "the embedded prior repairs views of a scene and generates no images from text alone; name a Stable "
            "Diffusion model: --prior sd21 or a diffusers folder"
        )
    return None


def generate_images(
    prior_name: str, prompts: Sequence[Prompt], settings: ImageSettings, folder: Path, report: Report
) -> tuple[tuple[ReferenceImage, ...], str | None]:
    """Writes images to `folder` (none accepted) and returns them, or the reason why this prior generates none.

    Raises InputError for a missing or broken prior, UsageError without positive prompts.
    """
    reason = no_images_reason(prior_name)
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
    images = []
    pipeline = _pipeline(prior)
    for number in range(settings.count):
        prompt = wanted[number % len(wanted)]
        report(f"picture {number + 1} of {settings.count}: {prompt.text}")
        image = _draw(pipeline, prior.size, prompt, negative, settings, number)
        name = _free_name(folder)
        write_atomic(folder / name, _png(image))
        images.append(ReferenceImage(f"{folder.name}/{name}", prompt.text, prior.folder.name[-200:]))
    write_atomic(folder / PAGE, encoded(contact_sheet(images)))
    return tuple(images), None


def contact_sheet(images: Sequence[ReferenceImage]) -> str:
    """Returns a page of the images with their prompts, which loads nothing else."""
    figures = "".join(
        f'<figure><img src="{escape(Path(image.file).name)}" alt="" width="320"><figcaption>'
        f"{escape(Path(image.file).name)}: {escape(image.prompt)}</figcaption></figure>"
        for image in images
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
            f"the prior {name} takes no text; name a Stable Diffusion model: --prior sd21 or a diffusers folder",
        )
    if prior.class_embedding_width is not None:
        return (
            None,
            f"the prior {name} needs an image beside the text (unCLIP); name a text-to-image model: --prior sd21",
        )
    return prior, None


def _pipeline(prior: DiffusersPrior) -> Any:
    """Builds diffusers' pipeline from individually checked parts: model_index.json never names code to run."""
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


def _draw(pipeline: Any, size: int, prompt: Prompt, negative: str, settings: ImageSettings, number: int) -> Image.Image:
    """Generates one image; same seed, same image."""
    import torch

    from gsopt.sds.conditioning import with_view_word

    image: Image.Image = pipeline(
        prompt=with_view_word(prompt, "" if prompt.view == "all" else prompt.view),
        negative_prompt=negative or None,
        height=size,
        width=size,
        num_inference_steps=settings.steps,
        guidance_scale=settings.guidance_scale,
        generator=torch.Generator("cpu").manual_seed(settings.seed + number),
    ).images[0]
    return image


def _free_name(folder: Path) -> str:
    """Returns the first free number: images of an earlier call are never overwritten."""
    return next(name for n in range(1, 10_000) if not (folder / (name := f"{n:03d}.png")).exists())


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.convert("RGB").save(buffer, format="PNG")
    return buffer.getvalue()
