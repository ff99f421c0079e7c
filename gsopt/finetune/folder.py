"""The folder of a finished prior, in the layout of diffusers, with a card that says what it was made from."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gsopt.data.files import is_regular, read_json
from gsopt.events import to_json, write_atomic
from gsopt.finetune.training_config import Course
from gsopt.sds.priors.view_conditioned import CARD, STEPS

if TYPE_CHECKING:
    from gsopt.finetune.run import Lessons

LARGEST_SHARD = "14MB"
READABLE = 0o644


def write_folder(
    out: Path, unet: Any, lessons: Lessons, course: Course, base: Path | None, measured: Mapping[str, Any]
) -> None:
    """unet/ in half precision (`unet` too, afterwards), the noise schedule, gsopt_prior.json and the model card."""
    unet.half().save_pretrained(out / "unet", max_shard_size=LARGEST_SHARD, safe_serialization=True)
    config = read_json(out / "unet" / "config.json")
    config.pop("_name_or_path", None)  # where the base lay on this machine is nobody's business
    write_atomic(out / "unet" / "config.json", to_json(config))
    for file in (out / "unet").iterdir():
        file.chmod(READABLE)  # diffusers writes weights that only their owner may read
    index = {"_class_name": "GsoptViewPrior", "unet": ["diffusers", "UNet2DConditionModel"]}
    write_atomic(out / "model_index.json", to_json({**index, "scheduler": ["diffusers", "DDIMScheduler"]}))
    scheduler = {
        "_class_name": "DDIMScheduler",
        "num_train_timesteps": STEPS,
        "beta_schedule": "squaredcos_cap_v2",
        "prediction_type": "sample",
    }
    (out / "scheduler").mkdir(exist_ok=True)
    write_atomic(out / "scheduler" / "scheduler_config.json", to_json(scheduler))
    parameters = sum(value.numel() for value in unet.parameters())
    card = model_card(lessons, course, base, measured, parameters, list(map(_origin, lessons.train)))
    write_atomic(out / "README.md", card.encode())
    # Last: what has a card is whole.
    write_atomic(out / CARD, to_json({"size": lessons.size, "measured": dict(measured)}))


def _origin(scene: Path) -> dict[str, str]:
    """Name, category, creator and licence of a scene, as far as the renderer of a mesh wrote them beside it."""
    known: dict[str, Any] = {}
    if is_regular(scene / "object.json"):
        known = read_json(scene / "object.json")
    text = {key: str(known.get(key) or "not stated").splitlines()[0][:80] for key in ("category", "creator", "license")}
    return {"name": scene.name, **text}


def model_card(
    lessons: Lessons,
    course: Course,
    base: Path | None,
    measured: Mapping[str, Any],
    parameters: int,
    scenes: list[dict[str, str]],
) -> str:
    """Markdown: what the prior is, what it was trained on and how, what it can and cannot do."""
    started = f"the prior `{base.name}`" if base else "random weights"
    lines = [
        "# A view-conditioned diffusion prior made by gsopt",
        "",
        "A U-Net (`UNet2DConditionModel`) that is shown a render of a reconstruction from few views, its alpha, its",
        "uncertainty and the nearest input views carried over by its depth, and answers with the image that should be",
        "there (x0). It knows objects like those listed below and nothing else; on photographs of rooms or landscapes",
        "it is a denoiser at best.",
        _words(measured),
        "",
        f"- {parameters / 1e6:.1f} million parameters, float16, {lessons.size} px; torch {torch.__version__}",
        f"- started from {started}; {course.steps} steps of {course.batch} images, seed {course.seed}",
        f"- {len(lessons.train)} scenes, {lessons.fits} reconstructions of each; {len(lessons.val)} scenes held out",
        f"- course: `{json.dumps(asdict(course))}`",
        "",
        "## Measured on the held-out scenes",
        "",
        *_table(measured),
        *_understood(measured),
        "",
        "## Training data",
        "",
        "| scene | category | creator | licence |",
        "|---|---|---|---|",
        *(f"| {' | '.join(scene[key] for key in ('name', 'category', 'creator', 'license'))} |" for scene in scenes),
        "",
    ]
    return "\n".join(lines)


def _words(measured: Mapping[str, Any]) -> str:
    if "words" not in measured:
        return "It takes no words."
    return "It attends to the tokens of a small CLIP (`clip/`) that learned the captions of the same scenes."


def _understood(measured: Mapping[str, Any]) -> list[str]:
    words = measured.get("words")
    if not words:
        return []
    return [
        "",
        f"Of the words in {words['captions']} held-out captions its CLIP never met {words['unknown_words']:.0%}; a "
        f"picture fits its own caption best in {words['right_caption']:.0%} (by guessing {words['by_guessing']:.0%}).",
    ]


def _table(measured: Mapping[str, Any]) -> list[str]:
    if not measured:
        return ["Nothing was held out, so nothing is known."]
    repair = measured["repair"]
    x0 = measured["x0"]
    times = list(next(iter(x0.values())))
    return [
        f"PSNR in dB over {measured['renders']} renders: the render itself {measured['render']:.2f}, the nearest input "
        f"view carried over {measured['reference']:.2f}.",
        "",
        "| repair of the render in one step from t = | " + " | ".join(repair) + " |",
        "|---" * (len(repair) + 1) + "|",
        "| PSNR | " + " | ".join(f"{value:.2f}" for value in repair.values()) + " |",
        "",
        "| x0 from the noisy truth, knowing | " + " | ".join(f"t = {t}" for t in times) + " |",
        "|---" * (len(times) + 1) + "|",
        *(f"| {name} | " + " | ".join(f"{row[t]:.2f}" for t in times) + " |" for name, row in x0.items()),
    ]
