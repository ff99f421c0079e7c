"""Runs `gsopt finetune --on-views`: images, examples, training, folder. Each part is resumable."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.files import read_json
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic
from gsopt.finetune.claimed_folder import claim
from gsopt.finetune.on_views.batches import LATENTS, make_examples
from gsopt.finetune.on_views.folder import write_folder
from gsopt.finetune.on_views.images import TrainingImage
from gsopt.finetune.on_views.sample_sheet import sample_sheet
from gsopt.finetune.on_views.trainer import STATE, ImageTrainer
from gsopt.finetune.on_views.training_config import ImagePreparation, ImageTrainingConfig
from gsopt.sds.priors.folder import PRIOR_REMEDIES, DiffusersFolder, find_folder
from gsopt.sds.priors.stable_diffusion import LARGE_UNET_BYTES, DiffusersPrior, choose_device, has_bfloat16
from gsopt.sds.priors.view_conditioned import is_view_prior
from gsopt.sds.select_prior import EMBEDDED

PLAN = "finetune.json"
CARD = "README.md"
LOSS_SMOOTHING = 0.05
"""Share of a new loss in the displayed running mean."""
REPORT_EVERY = 10


def finetune(
    images: Sequence[TrainingImage],
    config: ImageTrainingConfig,
    preparation: ImagePreparation,
    out: Path,
    base: str,
    report: Report,
) -> dict[str, Any]:
    """Trains `base` on the images into `out` and returns the evaluation loss before and after.

    Resumes after a kill. Raises InputError for a base or images that cannot be read and for an `out` that holds
    something else, UsageError for a base of another kind.
    """
    folder = find_base(base)
    if out.expanduser().resolve() == folder.path.resolve():
        raise UsageError(f"`--base` and `-o` are the same folder, {out}. Give another -o: the base stays as it is.")
    prior = open_base(folder, config, preparation)
    claim_folder(out, images, config, preparation, base)
    if (out / CARD).exists():
        return dict(read_json(out / PLAN).get("measured") or {})
    report(f"{prior.name}: {len(images)} images, {preparation.count} variants each")
    examples = make_examples(prior, images, preparation, config.seed, out, report)
    trainer = ImageTrainer(prior, examples, config)
    if (out / STATE).exists():
        trainer.restore(out / STATE)
        report(f"continuing at step {trainer.step}")
    if trainer.before is None:
        trainer.before = trainer.evaluate()
    log = Log(out, trainer, report)
    if trainer.step == 0:
        log.show(0)
    trainer.run(out, log)
    evaluation = {"before": trainer.before, "after": trainer.evaluate()}
    write_atomic(out / PLAN, to_json({**read_json(out / PLAN), "measured": evaluation}))
    write_folder(out, trainer, images, preparation, evaluation["after"])
    for spare in (STATE, LATENTS):
        (out / spare).unlink(missing_ok=True)
    return evaluation


def use_threads(count: int) -> None:
    """Sets the CPU threads of the networks; 0 = all."""
    if count:
        torch.set_num_threads(count)


def find_base(name: str) -> DiffusersFolder:
    """Finds the diffusers folder to start from. Errors name --base."""
    if is_view_prior(EMBEDDED if name == "embedded" else Path(name).expanduser()) or name == "embedded":
        raise UsageError(
            f"`--on-views` trains Stable Diffusion, but `--base` {name} is a view-conditioned prior. Give sd21, a "
            "diffusers folder or a hub id; or drop --on-views to train on scenes with many views."
        )
    try:
        folder = find_folder(name)
    except (InputError, UsageError) as error:
        here = "Give --base a folder that was downloaded before, or connect to the network."
        text = str(error).replace(PRIOR_REMEDIES, here).replace("`--prior`", "`--base`")
        raise type(error)(text.replace("none of embedded, sd21", "not sd21")) from error
    if folder.adapter is not None:
        raise UsageError(
            f"`--base` {name} is itself a base with a LoRA, got by an earlier training. Give its own base, which its "
            "README.md names, and all images together."
        )
    if folder.unet.get("class_embed_type") is not None:
        raise UsageError(
            f"`--base` {name} takes image embeddings (SD 2.1-unCLIP), which training does not support. Give SD 2.1 "
            "itself: --base sd21."
        )
    return folder


def open_base(folder: DiffusersFolder, config: ImageTrainingConfig, preparation: ImagePreparation) -> DiffusersPrior:
    """Opens the base in the configured number format."""
    device = choose_device(config.device)
    dtype = config.dtype
    if dtype == "auto":
        on_cpu = device.type == "cpu"
        half = folder.unet_bytes >= LARGE_UNET_BYTES and has_bfloat16() if on_cpu else torch.cuda.is_bf16_supported()
        dtype = "bfloat16" if half and not config.full else "float32"
    return DiffusersPrior(folder, GuidanceConfig(size=preparation.size, dtype=dtype, device=config.device))


def claim_folder(
    out: Path, images: Sequence[TrainingImage], config: ImageTrainingConfig, preparation: ImagePreparation, base: str
) -> None:
    """Writes the training plan to `out`; raises InputError when `out` belongs to another one."""
    plan = {
        "on_views": [{"name": image.name, "text": image.text} for image in images],
        "study": asdict(config),
        "images": asdict(preparation),
        "base": base,
    }
    claim(out / PLAN, plan, "this kind", "other images")


class Log:
    """Logs every step: progress lines, train.jsonl, and sample sheets."""

    def __init__(self, out: Path, trainer: ImageTrainer, report: Report) -> None:
        self._out, self._training, self._report = out, trainer, report
        self._mean: float | None = None
        self._began, self._first = time.monotonic(), trainer.step

    def __call__(self, step: int, found: float) -> None:
        config = self._training.config
        self._mean = found if self._mean is None else self._mean + LOSS_SMOOTHING * (found - self._mean)
        if step % REPORT_EVERY == 0 or step == config.steps:
            seconds = time.monotonic() - self._began
            left = seconds / max(1, step - self._first) * (config.steps - step)
            self._report(f"step {step}/{config.steps}  loss {self._mean:.5f}  ETA {left / 60:.0f} min")
            with (self._out / "train.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps({"step": step, "loss": self._mean, "seconds": round(seconds, 1)}) + "\n")
        if config.sheet_every and (step % config.sheet_every == 0 or step == config.steps):
            self.show(step)

    def show(self, step: int) -> None:
        """Writes samples/step_NNNNNN.png."""
        if self._training.config.sheet_every:
            (self._out / "samples").mkdir(exist_ok=True)
            sample_sheet(self._training).save(self._out / "samples" / f"step_{step:06d}.png")
