"""Runs `gsopt finetune --shape`: training, evaluation, the prior's folder. Resumable, also after a pause."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gsopt.data.files import read_json
from gsopt.errors import UsageError
from gsopt.events import Report, write_atomic
from gsopt.finetune.claimed_folder import claim
from gsopt.finetune.shapes.evaluation import evaluate
from gsopt.finetune.shapes.samples import word_rows
from gsopt.finetune.shapes.trainer import ShapeTrainer
from gsopt.finetune.shapes.training_config import ShapeTrainingConfig
from gsopt.finetune.shapes.volumes import ShapeVolumes, split
from gsopt.finetune.trainer import STATE
from gsopt.shape_library.library_file import ShapeLibrary
from gsopt.shape_prior.folder import CARD_FILE, ShapePrior, write_card, write_weights
from gsopt.shape_prior.network import NetworkConfig, ShapeNetwork
from gsopt.shape_prior.vocabulary import vocabulary_of

LOG_EVERY = 50
"""Steps between two lines of train.jsonl."""
LOSS_SMOOTHING = 0.02


@dataclass(frozen=True)
class ShapeTraining:
    """Data, settings and place of a training."""

    library: ShapeLibrary
    held: tuple[str, ...]
    """Ids of entries that are left out; one in twelve when none is named."""
    config: ShapeTrainingConfig
    device: torch.device

    def trainer(self) -> tuple[ShapeTrainer, ShapeVolumes, tuple[str, ...]]:
        """The untrained network, the shapes to train on, and the vocabulary."""
        config = self.config
        train = ShapeVolumes.read(self.library, split(self.library, self.held)[0], self.device)
        vocabulary = vocabulary_of(train.entries)
        state = torch.random.get_rng_state()
        torch.manual_seed(config.seed)
        network = ShapeNetwork(network_config(config), len(vocabulary) + 1).to(self.device)
        torch.random.set_rng_state(state)
        return ShapeTrainer(network, config, word_rows(train, vocabulary)), train, vocabulary


def network_config(config: ShapeTrainingConfig) -> NetworkConfig:
    """The part of the settings that the network has."""
    return NetworkConfig(config.side, tuple(config.widths), config.blocks)


def find_device(name: str) -> torch.device:
    """`auto`, `cpu` or `cuda`. Raises UsageError for a GPU that torch does not find."""
    if name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"`--device` must be auto, cpu or cuda, got {name!r}. Drop the flag for auto.")
    if name == "cuda" and not torch.cuda.is_available():
        raise UsageError("`--device cuda`: torch finds no GPU. Drop the flag, or install torch for CUDA.")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def finetune_shapes(
    training: ShapeTraining, out: Path, report: Report, until: float = math.inf
) -> dict[str, Any] | None:
    """Trains into `out` and returns the evaluation, or None when the time `until` (monotonic) came first: the same
    call goes on. Raises InputError for an `out` that holds something else."""
    network_config(training.config)  # refused before anything is written
    _claim_folder(out, training)
    if (out / CARD_FILE).exists():
        return dict(read_json(out / CARD_FILE).get("measured") or {})
    trainer, train, vocabulary = training.trainer()
    if (out / STATE).exists():
        trainer.restore(out / STATE)
        report(f"continuing at step {trainer.step}")
    held = split(training.library, training.held)[1]
    report(f"{len(train)} shapes to train on, {len(held)} held out, {len(vocabulary)} words, {training.device}")
    trainer.run(train, out, _Log(out, trainer, report), until)
    if trainer.step < training.config.steps:
        report(f"paused after step {trainer.step}; the same command goes on")
        return None
    network = trainer.use_average()
    network.load_state_dict({name: value.half().float() for name, value in network.state_dict().items()})
    prior = ShapePrior(network, network_config(training.config), vocabulary, training.config.image_side)
    write_weights(out, prior)
    measured: dict[str, Any] = {}
    if held:
        shapes = ShapeVolumes.read(training.library, held, training.device)
        measured = evaluate(prior, shapes, training.library, training.config.seed, report)
    parameters = sum(value.numel() for value in network.parameters())
    write_atomic(out / "README.md", model_card(training, measured, parameters).encode())
    write_card(out, prior, measured)
    return measured


def _claim_folder(out: Path, training: ShapeTraining) -> None:
    """Writes the plan to `out`; raises InputError when `out` belongs to another one."""
    plan = {
        "course": asdict(training.config),
        "entries": [entry.id for entry in training.library.entries],
        "held": list(training.held),
    }
    claim(out / "finetune.json", plan, "a shape prior", "another library")


def model_card(training: ShapeTraining, measured: Mapping[str, Any], parameters: int) -> str:
    """Markdown: purpose, training data, quality and limits."""
    config = training.config
    train, held = split(training.library, training.held)
    licenses = sorted({training.library.entries[row].license or "not stated" for row in train})
    lines = [
        "# A 3D diffusion prior made by gsopt",
        "",
        "It completes shape and color of an object that one to three photos show (`gsopt train --prior shape:DIR`).",
        "It learned from voxels of things like those of its library, in their coarse colors; of other things it knows",
        "nothing, and fine texture it never saw.",
        "",
        f"- {parameters / 1e6:.1f} million parameters, float16, {config.side}³ voxels; torch {torch.__version__}",
        f"- {config.steps} steps of {config.batch} samples, seed {config.seed}, on {_device_name(training.device)}",
        f"- {len(train)} shapes, {len(held)} held out by id; licenses of the shapes: {', '.join(licenses)}",
        f"- course: `{json.dumps(asdict(config))}`",
        "",
        "## Measured on held-out shapes, one photo each",
        "",
        *_table(measured),
        "",
    ]
    return "\n".join(lines)


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "a CPU"


def _table(measured: Mapping[str, Any]) -> list[str]:
    if not measured:
        return ["Nothing was held out, so nothing was measured."]
    rows = [f"| {way} | {v['iou']:.3f} | {v['silhouette_error']:.4f} |" for way, v in measured["mean"].items()]
    head = ["| | IoU in space | share of wrong pixels in 8 unseen silhouettes |", "|---|---|---|"]
    return [f"{measured['shapes']} shapes; the library was asked without any held-out shape.", "", *head, *rows]


class _Log:
    """Logs the loss: progress lines and train.jsonl."""

    def __init__(self, out: Path, trainer: ShapeTrainer, report: Report) -> None:
        self._out, self._steps, self._report = out, trainer.config.steps, report
        self._mean: float | None = None
        self._began, self._first = time.monotonic(), trainer.step

    def __call__(self, step: int, found: float) -> None:
        self._mean = found if self._mean is None else self._mean + LOSS_SMOOTHING * (found - self._mean)
        if step % LOG_EVERY and step != self._steps:
            return
        seconds = time.monotonic() - self._began
        left = seconds / max(1, step - self._first) * (self._steps - step)
        self._report(f"step {step}/{self._steps}  loss {self._mean:.5f}  ETA {left / 60:.0f} min")
        with (self._out / "train.jsonl").open("a", encoding="utf-8") as log:
            log.write(json.dumps({"step": step, "loss": self._mean, "seconds": round(seconds, 1)}) + "\n")
