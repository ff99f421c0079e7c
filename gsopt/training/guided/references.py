"""The conditioning of a run: prompts and reference images, read, encoded and saved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.files import is_regular
from gsopt.data.image_files import IMAGE_FORMATS, bomb
from gsopt.data.scene import Scene
from gsopt.errors import InputError, UsageError
from gsopt.events import Report
from gsopt.geometry.cameras import Cameras
from gsopt.sds.candidate_views import square_views
from gsopt.sds.conditioning import Conditioning, encode
from gsopt.sds.priors.protocol import Images, Prior
from gsopt.sds.prompts import Prompt, accepted_images, read_prompts, write_prompts

FOLDER, CONDITIONING = "guidance", "conditioning.safetensors"
EMBEDDED_INPUTS = 8
"""Input views whose CLIP embeddings are averaged."""
MAX_REFERENCE_PIXELS = 64 << 20


def make_conditioning(config: GuidanceConfig, scene: Scene, prior: Prior, folder: Path, warn: Report) -> Conditioning:
    """The run's conditioning, prompts and images encoded, saved for a session that resumes the run."""
    prompts = read_guidance_prompts(config)
    references = read_references(reference_paths(config), prior.size)
    conditioning = encoded(config.image_weight, scene, prior, prompts, references)
    folder.mkdir(exist_ok=True)
    write_prompts(folder / "prompts.json", conditioning.prompts)
    conditioning.save(folder / CONDITIONING)
    for note in conditioning.notes:
        warn(note)
    if config.front_view is None and any(p.view not in ("all", "top") for p in prompts):
        warn(
            f"Some prompts are for one side, but no input view is named as the front: "
            f"{scene.train[0].name} is taken for it. Name the right one with --guidance.front-view."
        )
    return conditioning


def encoded(
    image_weight: float, scene: Scene, prior: Prior, prompts: Sequence[Prompt], references: Images
) -> Conditioning:
    """Prompts, reference images and some of the input views, encoded for a prior."""
    step = max(1, -(-len(scene.train) // EMBEDDED_INPUTS))
    inputs = square_views(scene.train[::step], prior.size, torch.ones(3)).images
    return encode(prior.encoder(), prompts, inputs, references, image_weight, prior.class_embedding_width)


def read_guidance_prompts(config: GuidanceConfig) -> list[Prompt]:
    """--prompt, --negative and --prompts together. InputError names the prompt that cannot be used."""
    prompts = [Prompt(text) for text in config.prompt]
    prompts += [Prompt(text, polarity="negative") for text in config.negative]
    return prompts + (list(read_prompts(Path(config.prompts))) if config.prompts else [])


def reference_paths(config: GuidanceConfig) -> tuple[str, ...]:
    """Paths of the reference images: those of `ref_image`, then those accepted in the prompts.json."""
    given, prompts = config.ref_image, config.prompts
    accepted = map(str, accepted_images(Path(prompts)) if prompts else ())
    return (*given, *(path for path in accepted if path not in given))


def read_references(paths: tuple[str, ...], size: int) -> Images:
    """Reference images, their middle squares on white. InputError for a file that is no image or too large."""
    pictures = [_read_reference(Path(path), size) for path in paths]
    return torch.stack(pictures) if pictures else torch.empty(0, 3, size, size)


def _read_reference(path: Path, size: int) -> Tensor:
    try:
        if not is_regular(path):
            raise OSError("no such file")
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            if reason := bomb(image, path, max_pixels=MAX_REFERENCE_PIXELS):
                raise ValueError(f"{reason}: too large")
            rgba = image.convert("RGBA")
        white = Image.new("RGBA", rgba.size, "white")
        picture = Image.alpha_composite(white, rgba).convert("RGB")
        side = min(picture.size)
        left, top = (picture.width - side) // 2, (picture.height - side) // 2
        picture = picture.resize((size, size), Image.Resampling.LANCZOS, (left, top, left + side, top + side))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"Cannot read the reference image {path}: {error}. Give a PNG, JPEG or WebP, or drop --ref-image."
        ) from error
    return torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8).view(size, size, 3).permute(2, 0, 1) / 255


def front_camera(config: GuidanceConfig, scene: Scene) -> Cameras:
    """The input camera that shows the front: the one named, else the first. UsageError for one that is not there."""
    front = config.front_view
    if front is not None and front >= len(scene.train):
        raise UsageError(
            f"`--guidance.front-view` must be below {len(scene.train)}, the number of input views, got {front}. "
            "Input views count from 0."
        )
    return scene.train[front or 0].camera
