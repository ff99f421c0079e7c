"""Writes the folder of a model trained on images, complete for guidance but small on disk.

Files of the base are hard links, which stay valid when the base is deleted (copies on file systems without links). The
trained weights are `lora/`, a few MB, or with --full a U-Net of its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open

from gsopt.errors import InputError
from gsopt.events import write_atomic
from gsopt.finetune.on_views.adapter import PIPELINE, save_adapter
from gsopt.finetune.on_views.images import TrainingImage
from gsopt.finetune.on_views.trainer import ImageTrainer
from gsopt.finetune.on_views.training_config import ImagePreparation, ImageTrainingConfig
from gsopt.sds.priors.folder import DiffusersFolder, weight_files
from gsopt.sds.priors.lora import ADAPTER

PARTS = ("scheduler", "tokenizer", "text_encoder", "vae", "feature_extractor", "image_encoder")
SMALL = (".json", ".txt")
READABLE = 0o644
DTYPES = {"F16": torch.float16, "BF16": torch.bfloat16, "F32": torch.float32}
MAX_NAMED_IMAGES = 30
"""Number of images listed on the card."""


def write_folder(
    out: Path, trainer: ImageTrainer, images: Sequence[TrainingImage], preparation: ImagePreparation, after: float
) -> None:
    """Writes all files; the card last, which marks the folder as complete."""
    base = trainer.prior.folder
    for part in PARTS:
        if (base.path / part).is_dir():
            _link_part(base.path / part, out / part)
    if trainer.config.full:
        _write_unet(base, trainer.unet, out)
    else:
        save_adapter(trainer.unet, out)
        _link_part(base.path / "unet", out / "unet")
    if (base.path / "model_index.json").is_file():
        _link(base.path / "model_index.json", out / "model_index.json")
    write_atomic(out / "README.md", model_card(trainer, images, preparation, after).encode())


def _link_part(part: Path, into: Path) -> None:
    """Links configurations, vocabularies and the weights in use; config.json last, which marks the part as complete."""
    into.mkdir(exist_ok=True)
    files = [p for p in sorted(part.iterdir()) if p.suffix in SMALL and p.is_file()]
    if any(p.name == "config.json" for p in files):
        files = [*weight_files(part), *sorted(files, key=lambda p: p.name == "config.json")]
    for file in files:
        _link(file, into / file.name)


def _link(source: Path, target: Path) -> None:
    """Makes a hard link, or a copy if impossible. Follows the symbolic links of the hub's cache."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        try:
            os.link(source.resolve(), temporary)
        except OSError:
            shutil.copyfile(source, temporary)
        os.replace(temporary, target)
        # A rename between two links to one file leaves the temporary name behind.
        temporary.unlink(missing_ok=True)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(
            f"Cannot write {target}: {error.strerror or error}. Free some space, then run again."
        ) from error


def _write_unet(base: DiffusersFolder, unet: Any, out: Path) -> None:
    """Writes the trained U-Net in the number format of its base's files."""
    with safe_open(weight_files(base.path / "unet")[0], framework="pt") as file:
        stored = file.get_slice(next(iter(file.keys()))).get_dtype()
    unfinished = out / "unet.part"
    try:
        unet.to(DTYPES.get(stored, torch.float32)).save_pretrained(unfinished, safe_serialization=True)
        for file_path in unfinished.iterdir():
            file_path.chmod(READABLE)  # diffusers restricts weights to their owner
        if (out / "unet").exists():
            shutil.rmtree(out / "unet")
        unfinished.rename(out / "unet")
    except OSError as error:
        raise InputError(f"Cannot write {out / 'unet'}: {error}. Free some space, then run again.") from error


def model_card(
    trainer: ImageTrainer, images: Sequence[TrainingImage], preparation: ImagePreparation, after: float
) -> str:
    """Returns Markdown: the trained weights, the images, the configuration, and how to use the model."""
    config, prior = trainer.config, trainer.prior
    count = sum(value.numel() for value in trainer.trained.values())
    texts = sorted({image.text for image in images})
    named = [f"- {image.name} ({image.text})" for image in images[:MAX_NAMED_IMAGES]]
    more = [f"- and {len(images) - MAX_NAMED_IMAGES} more"] if len(images) > MAX_NAMED_IMAGES else []
    what = "its whole U-Net" if config.full else f"a low-rank change (LoRA, rank {config.rank}) of its attention layers"
    lines = [
        f"# {prior.folder.name}, trained on {len(images)} images by gsopt",
        "",
        f"{what[0].upper()}{what[1:]} learned the images below: {count / 1e6:.2f} million numbers. It predicts "
        f"{prior.prediction}. License and limits are those of the base and of the images.",
        "",
        f"- base: `{prior.folder.name}`; {prior.size} px; torch {torch.__version__}",
        f"- {config.steps} steps of {config.batch} images, learning rate {config.rate:g}, seed {config.seed}",
        f"- study: `{json.dumps(asdict(config))}`",
        f"- images: `{json.dumps(asdict(preparation))}`",
        "- loss on fixed examples of these images, which measures training, not generalization: "
        f"{_loss(trainer.before)} before, {after:.5f} after",
        "",
        "## Use",
        "",
        "Use the prompts of its training:",
        "",
        "```bash",
        *(f"gsopt train DATA --prior {Path('PRIOR')} --prompt {json.dumps(text)}" for text in texts[:3]),
        "```",
        "",
        *_elsewhere(config),
        "## Images",
        "",
        *named,
        *more,
        "",
    ]
    return "\n".join(lines)


def _loss(value: float | None) -> str:
    return "not known" if value is None else f"{value:.5f}"


def _elsewhere(config: ImageTrainingConfig) -> list[str]:
    """Returns instructions for other tools."""
    if config.full:
        return []
    return [
        "The U-Net in `unet/` is the base's; gsopt adds the change when it loads the folder. In other tools:",
        "",
        "```python",
        "pipeline = diffusers.StableDiffusionPipeline.from_pretrained(PRIOR)",
        f"pipeline.load_lora_weights(PRIOR)  # {PIPELINE}",
        f'unet = peft.PeftModel.from_pretrained(unet, PRIOR + "/{ADAPTER}")  # or with peft alone',
        "```",
        "",
    ]
