"""The folder of a model that learned images: whole, so that it guides a run, and small, for most of it is its base's.

Files of the base are hard-linked: no disk is used, and they stay when the base goes (copied where the file system knows
no links). What was learned is `lora/`, a few MB, or with --full a U-Net of its own.
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
from gsopt.finetune.on_views.images import Picture
from gsopt.finetune.on_views.trainer import Training
from gsopt.finetune.on_views.training_config import Preparation, Study
from gsopt.sds.priors.folder import DiffusersFolder, weight_files
from gsopt.sds.priors.lora import ADAPTER

PARTS = ("scheduler", "tokenizer", "text_encoder", "vae", "feature_extractor", "image_encoder")
SMALL = (".json", ".txt")
READABLE = 0o644
DTYPES = {"F16": torch.float16, "BF16": torch.bfloat16, "F32": torch.float32}
NAMED = 30
"""Pictures that the card names."""


def write_folder(out: Path, training: Training, pictures: Sequence[Picture], how: Preparation, after: float) -> None:
    """Everything; the card last, which says that the folder is complete."""
    base = training.prior.folder
    for part in PARTS:
        if (base.path / part).is_dir():
            _link_part(base.path / part, out / part)
    if training.study.full:
        _write_unet(base, training.unet, out)
    else:
        save_adapter(training.unet, out)
        _link_part(base.path / "unet", out / "unet")
    if (base.path / "model_index.json").is_file():
        _link(base.path / "model_index.json", out / "model_index.json")
    write_atomic(out / "README.md", model_card(training, pictures, how, after).encode())


def _link_part(part: Path, into: Path) -> None:
    """Configurations, vocabularies and the weights in use; config.json last, which says that the part is there."""
    into.mkdir(exist_ok=True)
    files = [p for p in sorted(part.iterdir()) if p.suffix in SMALL and p.is_file()]
    if any(p.name == "config.json" for p in files):
        files = [*weight_files(part), *sorted(files, key=lambda p: p.name == "config.json")]
    for file in files:
        _link(file, into / file.name)


def _link(source: Path, target: Path) -> None:
    """A hard link, or a copy where none can be made. The hub's cache holds symbolic links: followed."""
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        try:
            os.link(source.resolve(), temporary)
        except OSError:
            shutil.copyfile(source, temporary)
        os.replace(temporary, target)
        # Where both are links to one file already, a rename leaves the temporary name behind.
        temporary.unlink(missing_ok=True)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(
            f"Cannot write {target}: {error.strerror or error}. Free some space, then run again."
        ) from error


def _write_unet(base: DiffusersFolder, unet: Any, out: Path) -> None:
    """The trained U-Net in the number format of its base's files."""
    with safe_open(weight_files(base.path / "unet")[0], framework="pt") as file:
        stored = file.get_slice(next(iter(file.keys()))).get_dtype()
    unfinished = out / "unet.part"
    try:
        unet.to(DTYPES.get(stored, torch.float32)).save_pretrained(unfinished, safe_serialization=True)
        for file_path in unfinished.iterdir():
            file_path.chmod(READABLE)  # diffusers writes weights that only their owner may read
        if (out / "unet").exists():
            shutil.rmtree(out / "unet")
        unfinished.rename(out / "unet")
    except OSError as error:
        raise InputError(f"Cannot write {out / 'unet'}: {error}. Free some space, then run again.") from error


def model_card(training: Training, pictures: Sequence[Picture], how: Preparation, after: float) -> str:
    """Markdown: what was learned from what, how, and how it is used."""
    study, prior = training.study, training.prior
    count = sum(value.numel() for value in training.trained.values())
    texts = sorted({picture.text for picture in pictures})
    named = [f"- {picture.name} ({picture.text})" for picture in pictures[:NAMED]]
    more = [f"- and {len(pictures) - NAMED} more"] if len(pictures) > NAMED else []
    what = "its whole U-Net" if study.full else f"a low-rank change (LoRA, rank {study.rank}) of its attention layers"
    lines = [
        f"# {prior.folder.name}, trained on {len(pictures)} images by gsopt",
        "",
        f"{what[0].upper()}{what[1:]} learned the images below: {count / 1e6:.2f} million numbers. It predicts "
        f"{prior.prediction}. Licence and limits are those of the base and of the images.",
        "",
        f"- base: `{prior.folder.name}`; {prior.size} px; torch {torch.__version__}",
        f"- {study.steps} steps of {study.batch} images, learning rate {study.rate:g}, seed {study.seed}",
        f"- study: `{json.dumps(asdict(study))}`",
        f"- images: `{json.dumps(asdict(how))}`",
        "- loss of fixed lessons about these images, which says what was learned, not how well it carries over: "
        f"{_loss(training.before)} before, {after:.5f} after",
        "",
        "## Use",
        "",
        "Say the words it learned:",
        "",
        "```bash",
        *(f"gsopt train DATA --prior {Path('PRIOR')} --prompt {json.dumps(text)}" for text in texts[:3]),
        "```",
        "",
        *_elsewhere(study),
        "## Images",
        "",
        *named,
        *more,
        "",
    ]
    return "\n".join(lines)


def _loss(value: float | None) -> str:
    return "not known" if value is None else f"{value:.5f}"


def _elsewhere(study: Study) -> list[str]:
    """How other tools take it."""
    if study.full:
        return []
    return [
        "The U-Net in `unet/` is the base's; gsopt adds the change when it loads the folder. Other tools add it so:",
        "",
        "```python",
        "pipeline = diffusers.StableDiffusionPipeline.from_pretrained(PRIOR)",
        f"pipeline.load_lora_weights(PRIOR)  # {PIPELINE}",
        f'unet = peft.PeftModel.from_pretrained(unet, PRIOR + "/{ADAPTER}")  # or with peft alone',
        "```",
        "",
    ]
