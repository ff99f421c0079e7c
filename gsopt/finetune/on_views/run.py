"""`gsopt finetune --on-views` in order: images, lessons, training, folder. Each part goes on where it was."""

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
from gsopt.finetune.on_views.batches import LATENTS, make_lessons
from gsopt.finetune.on_views.folder import write_folder
from gsopt.finetune.on_views.images import Picture
from gsopt.finetune.on_views.sample_sheet import sheet
from gsopt.finetune.on_views.trainer import STATE, Training
from gsopt.finetune.on_views.training_config import Preparation, Study
from gsopt.sds.priors.folder import REMEDIES, DiffusersFolder, find_folder
from gsopt.sds.priors.stable_diffusion import LARGE, DiffusersPrior, choose_device, has_bfloat16
from gsopt.sds.priors.view_conditioned import is_view_prior
from gsopt.sds.select_prior import EMBEDDED

PLAN = "finetune.json"
CARD = "README.md"
NEWS = 0.05
"""Share of a new loss in the running mean that is shown."""
TOLD_EVERY = 10


def finetune(
    pictures: Sequence[Picture], study: Study, how: Preparation, out: Path, base: str, report: Report
) -> dict[str, Any]:
    """Train `base` on the pictures into `out`; the exam's loss before and after.

    Run again after a kill it goes on where it was. Raises InputError for a base or pictures that cannot be read and for
    an `out` that holds something else, UsageError for a base of another kind.
    """
    folder = find_base(base)
    if out.expanduser().resolve() == folder.path.resolve():
        raise UsageError(f"`--base` and `-o` are the same folder, {out}. Give another -o: the base stays as it is.")
    prior = open_base(folder, study, how)
    claim(out, pictures, study, how, base)
    if (out / CARD).exists():
        return dict(read_json(out / PLAN).get("measured") or {})
    report(f"{prior.name}: {len(pictures)} images, {how.count} variants each")
    lessons = make_lessons(prior, pictures, how, study.seed, out, report)
    training = Training(prior, lessons, study)
    if (out / STATE).exists():
        training.restore(out / STATE)
        report(f"continuing at step {training.step}")
    if training.before is None:
        training.before = training.exam()
    log = Log(out, training, report)
    if training.step == 0:
        log.show(0)
    training.run(out, log)
    measured = {"before": training.before, "after": training.exam()}
    write_atomic(out / PLAN, to_json({**read_json(out / PLAN), "measured": measured}))
    write_folder(out, training, pictures, how, measured["after"])
    for spare in (STATE, LATENTS):
        (out / spare).unlink(missing_ok=True)
    return measured


def use_threads(count: int) -> None:
    """CPU threads of the networks; 0 = all."""
    if count:
        torch.set_num_threads(count)


def find_base(name: str) -> DiffusersFolder:
    """The diffusers folder to start from. Errors speak of --base."""
    if is_view_prior(EMBEDDED if name == "embedded" else Path(name).expanduser()) or name == "embedded":
        raise UsageError(
            f"`--on-views` trains Stable Diffusion, but `--base` {name} is a view-conditioned prior. Give sd21, a "
            "diffusers folder or a hub id; or drop --on-views to train on scenes with many views."
        )
    try:
        folder = find_folder(name)
    except (InputError, UsageError) as error:
        here = "Give --base a folder that was downloaded before, or connect to the network."
        text = str(error).replace(REMEDIES, here).replace("`--prior`", "`--base`")
        raise type(error)(text.replace("none of embedded, sd21", "not sd21")) from error
    if folder.adapter is not None:
        raise UsageError(
            f"`--base` {name} is itself a base with a LoRA, got by an earlier training. Give its own base, which its "
            "README.md names, and all images together."
        )
    if folder.unet.get("class_embed_type") is not None:
        raise UsageError(
            f"`--base` {name} takes image embeddings (SD 2.1-unCLIP), which training does not know. Give SD 2.1 "
            "itself: --base sd21."
        )
    return folder


def open_base(folder: DiffusersFolder, study: Study, how: Preparation) -> DiffusersPrior:
    """The base in the number format of the study."""
    device = choose_device(study.device)
    dtype = study.dtype
    if dtype == "auto":
        on_cpu = device.type == "cpu"
        half = folder.unet_bytes >= LARGE and has_bfloat16() if on_cpu else torch.cuda.is_bf16_supported()
        dtype = "bfloat16" if half and not study.full else "float32"
    return DiffusersPrior(folder, GuidanceConfig(size=how.size, dtype=dtype, device=study.device))


def claim(out: Path, pictures: Sequence[Picture], study: Study, how: Preparation, base: str) -> None:
    """Remember what `out` is made from; InputError where it is something else."""
    plan = {
        "on_views": [{"name": picture.name, "text": picture.text} for picture in pictures],
        "study": asdict(study),
        "images": asdict(how),
        "base": base,
    }
    path = out / PLAN
    if path.exists():
        found = {key: value for key, value in read_json(path).items() if key != "measured"}
        if found != json.loads(to_json(plan)):
            raise InputError(f"{out} belongs to a training with other images or flags. Repeat them or give another -o.")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty and holds no training of this kind. Give another -o.")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make {out}: {error.strerror or error}. Give another -o.") from error
    write_atomic(path, to_json(plan))


class Log:
    """Hears every step: a line now and then, train.jsonl, and sample sheets."""

    def __init__(self, out: Path, training: Training, report: Report) -> None:
        self._out, self._training, self._report = out, training, report
        self._mean: float | None = None
        self._began, self._first = time.monotonic(), training.step

    def __call__(self, step: int, found: float) -> None:
        study = self._training.study
        self._mean = found if self._mean is None else self._mean + NEWS * (found - self._mean)
        if step % TOLD_EVERY == 0 or step == study.steps:
            seconds = time.monotonic() - self._began
            left = seconds / max(1, step - self._first) * (study.steps - step)
            self._report(f"step {step}/{study.steps}  loss {self._mean:.5f}  ETA {left / 60:.0f} min")
            with (self._out / "train.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps({"step": step, "loss": self._mean, "seconds": round(seconds, 1)}) + "\n")
        if study.sheet_every and (step % study.sheet_every == 0 or step == study.steps):
            self.show(step)

    def show(self, step: int) -> None:
        """samples/step_NNNNNN.png"""
        if self._training.study.sheet_every:
            (self._out / "samples").mkdir(exist_ok=True)
            sheet(self._training).save(self._out / "samples" / f"step_{step:06d}.png")
