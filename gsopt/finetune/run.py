"""Runs `gsopt finetune`: reconstructions, training, evaluation, the prior's folder. Each part is resumable."""

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
from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.farm.job import Farm
from gsopt.farm.open import available_cores, open_farm
from gsopt.finetune.caption_tokens import SceneCaptions, encode_captions
from gsopt.finetune.claimed_folder import claim
from gsopt.finetune.evaluation import evaluate, sample_sheet
from gsopt.finetune.folder import write_folder
from gsopt.finetune.pair_cache import PairCache, collect_pairs
from gsopt.finetune.scenes import TrainingScenes
from gsopt.finetune.text_encoder import evaluate_encoder, make_encoder, scene_texts
from gsopt.finetune.trainer import STATE, PriorTrainer
from gsopt.finetune.training_config import PriorTrainingConfig
from gsopt.sds.priors.view_conditioned import (
    CARD_FILE,
    CLIP_FOLDER,
    ViewPrior,
    is_view_prior,
    make_unet,
    zero_text_attention,
)
from gsopt.sds.select_prior import EMBEDDED

SHEET_EVERY = 500
"""Steps between two sample sheets."""
LOSS_SMOOTHING = 0.02
"""Share of a new loss in the displayed running mean."""


def start(
    scenes: TrainingScenes,
    config: PriorTrainingConfig,
    out: Path,
    base: str | None,
    threads: int,
    farm: str,
    report: Report,
) -> dict[str, Any]:
    """Runs `finetune`; `base` and `farm` as on the command line."""
    if threads:
        torch.set_num_threads(threads)
    folder = None if base is None else EMBEDDED if base == "embedded" else Path(base)
    return finetune(scenes, config, out, open_farm(farm, threads or available_cores()), folder, report)


def finetune(
    scenes: TrainingScenes, config: PriorTrainingConfig, out: Path, farm: Farm, base: Path | None, report: Report
) -> dict[str, Any]:
    """Has `farm` reconstruct the scenes, trains a prior into `out` and returns its evaluation on the held-out scenes.

    Resumes after a kill. Raises InputError for scenes that cannot be read and for an `out`
    that holds something else.
    """
    _claim_folder(out, scenes, config, base)
    train, val = (_library(paths, scenes, out / "pairs", farm, report) for paths in (scenes.train, scenes.val))
    assert train is not None
    held = 0 if val is None else len(val.pairs)
    report(f"{len(train.pairs)} renders of {len(scenes.train)} scenes to train on, {held} held out")
    encoder = make_encoder(train, config, out / CLIP_FOLDER, base, report)
    captions, told_val = (
        None if encoder is None or part is None else encode_captions(encoder, part, scene_texts(part))
        for part in (train, val)
    )
    trainer = PriorTrainer(
        make_unet(config.seed) if base is None else _base(base, captions is not None), config, captions
    )
    if (out / STATE).exists():
        trainer.restore(out / STATE)
        report(f"continuing at step {trainer.step}")
    if trainer.step == config.steps and (out / CARD_FILE).exists():
        return dict(read_json(out / CARD_FILE).get("measured") or {})
    trainer.run(train.pairs, out, _Log(out, trainer, val, told_val, report))
    unet = trainer.use_average()
    evaluation = {} if val is None else evaluate(unet, val.pairs, told_val)
    if encoder is not None and val is not None:
        evaluation |= {"words": evaluate_encoder(encoder, val)}
    write_folder(out, unet, scenes, config, base, evaluation)
    return evaluation


def _claim_folder(out: Path, scenes: TrainingScenes, config: PriorTrainingConfig, base: Path | None) -> None:
    """Writes the training plan to `out`; raises InputError when `out` belongs to another one."""
    plan = {
        "course": asdict(config),
        "fits": scenes.reconstructions,
        "size": scenes.size,
        "seed": scenes.seed,
        "train": [scene.name for scene in scenes.train],
        "val": [scene.name for scene in scenes.val],
        "base": None if base is None else base.name,
    }
    claim(out / "finetune.json", plan, "a prior", "other scenes", beside="pairs")


def _library(
    paths: Sequence[Path], scenes: TrainingScenes, folder: Path, farm: Farm, report: Report
) -> PairCache | None:
    if not paths:
        return None
    return collect_pairs(paths, scenes.reconstructions, scenes.size, scenes.seed, folder, farm, report)


def _base(folder: Path, captions: bool) -> Any:
    """Loads the network to start from; text attention that was not trained yet starts without effect."""
    if not is_view_prior(folder):
        raise InputError(
            f"`--base` {folder} is no view-conditioned prior. Give a folder that `gsopt finetune` wrote; "
            "to train Stable Diffusion on images, add --on-views."
        )
    unet = ViewPrior(folder, GuidanceConfig()).unet.requires_grad_(True)
    if captions and not (folder / CLIP_FOLDER).is_dir():
        zero_text_attention(unet)
    return unet


class _Log:
    """Logs every step: progress lines, train.jsonl, and sample sheets of held-out renders."""

    def __init__(
        self, out: Path, trainer: PriorTrainer, val: PairCache | None, captions: SceneCaptions | None, report: Report
    ) -> None:
        self._out, self._course, self._training, self._report = out, trainer.config, trainer, report
        self._val, self._told = val, captions
        self._mean: float | None = None
        self._began, self._first = time.monotonic(), trainer.step

    def __call__(self, step: int, found: float) -> None:
        self._mean = found if self._mean is None else self._mean + LOSS_SMOOTHING * (found - self._mean)
        if step % 100 == 0 or step == self._course.steps:
            seconds = time.monotonic() - self._began
            left = seconds / max(1, step - self._first) * (self._course.steps - step)
            self._report(f"step {step}/{self._course.steps}  loss {self._mean:.5f}  ETA {left / 60:.0f} min")
            with (self._out / "train.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps({"step": step, "loss": self._mean, "seconds": round(seconds, 1)}) + "\n")
        if self._val is not None and step % SHEET_EVERY == 0:
            self._show(step)

    def _show(self, step: int) -> None:
        unet = self._training.use_average()
        folder = self._out / "samples"
        folder.mkdir(exist_ok=True)
        assert self._val is not None
        with torch.no_grad():
            sample_sheet(unet, self._val.pairs, self._told).save(folder / f"step_{step:06d}.png")
        self._training.use_trained()
