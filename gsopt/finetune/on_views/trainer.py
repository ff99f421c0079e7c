"""Trains Stable Diffusion's U-Net on images, by a low-rank change or in full, resumable bit for bit.

    (1)  L = mean( (f(x_t, t, words) - target)^2 ),   x_t as in `noise` (1), target: eps, v or x0, as predicted

with t uniform (Ho et al. 2020, eq. 14; DreamBooth, Ruiz et al. 2023, without the prior-preservation term).
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsopt.errors import InputError, NumericalError
from gsopt.finetune.on_views.adapter import attach
from gsopt.finetune.on_views.batches import TrainingExample, TrainingExamples
from gsopt.finetune.on_views.training_config import ImageTrainingConfig
from gsopt.sds.noise import add_noise, output_for
from gsopt.sds.priors.stable_diffusion import LARGE_UNET_BYTES, DiffusersPrior

STATE = "training.safetensors"
EVALUATION_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)
EVALUATION_IMAGES = 4


class ImageTrainer:
    """U-Net, optimizer and progress of one training."""

    def __init__(self, prior: DiffusersPrior, examples: TrainingExamples, config: ImageTrainingConfig) -> None:
        self.prior, self.examples, self.config, self.step = prior, examples, config, 0
        self.before: float | None = None
        """Evaluation loss at the start."""
        self.unet = prior.unet
        if config.full:
            self.unet.requires_grad_(True)
        else:
            attach(self.unet, config.rank, config.seed)
        if prior.folder.unet_bytes >= LARGE_UNET_BYTES:
            self.unet.enable_gradient_checkpointing()
        self.trained: dict[str, Tensor] = {n: p for n, p in self.unet.named_parameters() if p.requires_grad}
        self.optimizer = torch.optim.AdamW(self.trained.values(), lr=config.rate, weight_decay=0.01)

    def advance(self) -> float:
        """Takes one step and returns its loss. Raises NumericalError when it is not finite; the last saved state is
        valid."""
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = config.rate_at(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for row in range(config.batch):
            found = loss(self.prior, self.examples.draw(config.seed, self.step, row, len(self.prior.schedule)))
            if not bool(torch.isfinite(found)):
                raise NumericalError(
                    f"The loss of step {self.step} is {float(found)}. Lower --lr, or use --dtype float32, and give "
                    "another -o."
                )
            (found / config.batch).backward()
            total += float(found.detach()) / config.batch
        torch.nn.utils.clip_grad_norm_(self.trained.values(), 1.0)
        self.optimizer.step()
        self.step += 1
        return total

    def run(self, folder: Path, on_step: Callable[[int, float], None]) -> None:
        """Trains to the last step and saves regularly; calls `on_step` with every step and its loss."""
        while self.step < self.config.steps:
            found = self.advance()
            if self.step % self.config.save_every == 0 or self.step == self.config.steps:
                self.save(folder / STATE)
            on_step(self.step, found)

    @torch.no_grad()
    def evaluate(self) -> float:
        """Returns the mean loss of fixed examples over some images and noise steps."""
        times = [self.prior.schedule.step(share) for share in EVALUATION_TIMES]
        images = range(min(EVALUATION_IMAGES, len(self.examples.latents)))
        found = [float(loss(self.prior, self.examples.fixed(image, t))) for image in images for t in times]
        return sum(found) / len(found)

    def save(self, path: Path) -> None:
        """Writes the trained weights, the optimizer's state and the step, atomically."""
        tensors: dict[str, Tensor] = {f"unet.{name}": value.detach() for name, value in self.trained.items()}
        for index, record in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in record.items()}
        meta = json.dumps({"step": self.step, "before": self.before, "study": asdict(self.config)})
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            save_file({k: v.contiguous() for k, v in tensors.items()}, temporary, metadata={"gsopt": meta})
            os.replace(temporary, path)
        except (OSError, SafetensorError) as error:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise InputError(f"Cannot write {path}: {error}. Free some space, then give the same command.") from error

    def restore(self, path: Path) -> None:
        """Inverse of `save`. Raises InputError for the state of another configuration or a broken file."""
        try:
            with safe_open(path, framework="pt") as file:
                meta = json.loads((file.metadata() or {})["gsopt"])
                tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
            if meta["study"] != asdict(self.config):
                raise ValueError(f"it belongs to a training with {meta['study']}")
            self._load(tensors)
            self.step, self.before = int(meta["step"]), meta["before"]
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise InputError(
                f"Cannot continue from {path} ({error}). Give the flags the training began with, or another -o."
            ) from error

    @torch.no_grad()
    def _load(self, tensors: dict[str, Tensor]) -> None:
        records: dict[int, dict[str, Any]] = {}
        for name, parameter in self.trained.items():
            parameter.copy_(tensors[f"unet.{name}"])
        for name, value in tensors.items():
            kind, index, *key = name.split(".", 2)
            if kind == "optimizer":
                records.setdefault(int(index), {})[key[0]] = value
        state = self.optimizer.state_dict()
        self.optimizer.load_state_dict({**state, "state": records})


def loss(prior: DiffusersPrior, example: TrainingExample) -> Float[Tensor, ""]:
    """Equation (1)."""
    z, eps = example.z.to(prior.device), example.eps.to(prior.device)
    signal = prior.schedule.signal(example.t, z)
    output = prior.unet(
        add_noise(z, eps, signal).to(prior.dtype),
        example.t.to(prior.device),
        encoder_hidden_states=None if example.tokens is None else example.tokens.to(prior.device, prior.dtype),
    ).sample
    return (output.float() - output_for(z, eps, signal, prior.prediction)).square().mean()
