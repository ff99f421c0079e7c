"""Writes the folder of a finished prior in the layout of diffusers, with a model card."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from gsopt.data.files import is_regular, read_json
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic
from gsopt.finetune.half_precision import in_half_precision
from gsopt.finetune.scenes import TrainingScenes
from gsopt.finetune.training_config import PriorTrainingConfig
from gsopt.sds.priors.view_conditioned import CARD_FILE, NOISE_STEPS

LARGEST_SHARD = "14MB"
READABLE = 0o644


def write_folder(
    out: Path,
    unet: Any,
    scenes: TrainingScenes,
    config: PriorTrainingConfig,
    base: Path | None,
    evaluation: Mapping[str, Any],
) -> None:
    """Writes unet/ in half precision (converts `unet` in place), the noise schedule, gsopt_prior.json and the card."""
    try:
        in_half_precision(unet).save_pretrained(out / "unet", max_shard_size=LARGEST_SHARD, safe_serialization=True)
    except SafetensorError as error:
        raise InputError(f"{out / 'unet'}: {error}. Make room, then give the same command again.") from error
    unet_config = read_json(out / "unet" / "config.json")
    unet_config.pop("_name_or_path", None)  # the path of the base on this machine is private
    write_atomic(out / "unet" / "config.json", to_json(unet_config))
    for file in (out / "unet").iterdir():
        file.chmod(READABLE)  # diffusers restricts weights to their owner
    index = {"_class_name": "GsoptViewPrior", "unet": ["diffusers", "UNet2DConditionModel"]}
    write_atomic(out / "model_index.json", to_json({**index, "scheduler": ["diffusers", "DDIMScheduler"]}))
    scheduler = {
        "_class_name": "DDIMScheduler",
        "num_train_timesteps": NOISE_STEPS,
        "beta_schedule": "squaredcos_cap_v2",
        "prediction_type": "sample",
    }
    (out / "scheduler").mkdir(exist_ok=True)
    write_atomic(out / "scheduler" / "scheduler_config.json", to_json(scheduler))
    parameters = sum(value.numel() for value in unet.parameters())
    card = model_card(scenes, config, base, evaluation, parameters, list(map(_origin, scenes.train)))
    write_atomic(out / "README.md", card.encode())
    # Written last: a folder with a card is complete.
    write_atomic(out / CARD_FILE, to_json({"size": scenes.size, "measured": dict(evaluation)}))


def _origin(scene: Path) -> dict[str, str]:
    """Returns name, category, creator and license of a scene, as written beside it by the renderer of its mesh."""
    known: dict[str, Any] = {}
    if is_regular(scene / "object.json"):
        known = read_json(scene / "object.json")
    text = {key: str(known.get(key) or "not stated").splitlines()[0][:80] for key in ("category", "creator", "license")}
    return {"name": scene.name, **text}


def model_card(
    scenes: TrainingScenes,
    config: PriorTrainingConfig,
    base: Path | None,
    evaluation: Mapping[str, Any],
    parameters: int,
    origins: list[dict[str, str]],
) -> str:
    """Returns Markdown: the prior's purpose, training data, training configuration, measured quality and limits."""
    started = f"the prior `{base.name}`" if base else "random weights"
    lines = [
        "# A view-conditioned diffusion prior made by gsopt",
        "",
        "A U-Net (`UNet2DConditionModel`) that takes a render of a reconstruction from few views, its alpha, its",
        "uncertainty and the nearest input views warped by its depth, and predicts the image that should be",
        "there (x0). It is trained on objects like those listed below only; on photographs of rooms or landscapes",
        "it is a denoiser at best.",
        _words(evaluation),
        "",
        f"- {parameters / 1e6:.1f} million parameters, float16, {scenes.size} px; torch {torch.__version__}",
        f"- started from {started}; {config.steps} steps of {config.batch} images, seed {config.seed}",
        f"- {len(scenes.train)} scenes, {scenes.reconstructions} reconstructions of each; {len(scenes.val)} held out",
        f"- course: `{json.dumps(asdict(config))}`",
        "",
        "## Measured on the held-out scenes",
        "",
        *_table(evaluation),
        *_encoder_lines(evaluation),
        "",
        "## Training data",
        "",
        "| scene | category | creator | license |",
        "|---|---|---|---|",
        *(f"| {' | '.join(scene[key] for key in ('name', 'category', 'creator', 'license'))} |" for scene in origins),
        "",
    ]
    return "\n".join(lines)


def _words(evaluation: Mapping[str, Any]) -> str:
    if "words" not in evaluation:
        return "It takes no words."
    return "It attends to the tokens of a small CLIP (`clip/`) that learned the captions of the same scenes."


def _encoder_lines(evaluation: Mapping[str, Any]) -> list[str]:
    words = evaluation.get("words")
    if not words:
        return []
    return [
        "",
        f"Of the words in {words['captions']} held-out captions its CLIP never met {words['unknown_words']:.0%}; a "
        f"picture fits its own caption best in {words['right_caption']:.0%} (by guessing {words['by_guessing']:.0%}).",
    ]


def _table(evaluation: Mapping[str, Any]) -> list[str]:
    if not evaluation:
        return ["Nothing was held out, so nothing was measured."]
    repair = evaluation["repair"]
    x0 = evaluation["x0"]
    times = list(next(iter(x0.values())))
    return [
        f"PSNR in dB over {evaluation['renders']} renders: the render itself {evaluation['render']:.2f}, the nearest "
        f"input view warped {evaluation['reference']:.2f}.",
        "",
        "| repair of the render in one step from t = | " + " | ".join(repair) + " |",
        "|---" * (len(repair) + 1) + "|",
        "| PSNR | " + " | ".join(f"{value:.2f}" for value in repair.values()) + " |",
        "",
        "| x0 from the noisy truth, knowing | " + " | ".join(f"t = {t}" for t in times) + " |",
        "|---" * (len(times) + 1) + "|",
        *(f"| {name} | " + " | ".join(f"{row[t]:.2f}" for t in times) + " |" for name, row in x0.items()),
    ]
