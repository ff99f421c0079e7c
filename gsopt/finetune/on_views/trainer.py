"""The training of Stable Diffusion's U-Net on images: a low-rank change of it, or all of it; resumable to the bit.

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
from gsopt.finetune.on_views.batches import Lesson, Lessons
from gsopt.finetune.on_views.training_config import Study
from gsopt.sds.noise import add_noise, output_for
from gsopt.sds.priors.stable_diffusion import LARGE, DiffusersPrior

STATE = "training.safetensors"
EXAM_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)
EXAM_PICTURES = 4


class Training:
    """U-Net, optimizer and progress of one study."""

    def __init__(self, prior: DiffusersPrior, lessons: Lessons, study: Study) -> None:
        self.prior, self.lessons, self.study, self.step = prior, lessons, study, 0
        self.before: float | None = None
        """Loss of the exam at the start."""
        self.unet = prior.unet
        if study.full:
            self.unet.requires_grad_(True)
        else:
            attach(self.unet, study.rank, study.seed)
        if prior.folder.unet_bytes >= LARGE:
            self.unet.enable_gradient_checkpointing()
        self.trained: dict[str, Tensor] = {n: p for n, p in self.unet.named_parameters() if p.requires_grad}
        self.optimizer = torch.optim.AdamW(self.trained.values(), lr=study.rate, weight_decay=0.01)

    def advance(self) -> float:
        """One step; its loss. NumericalError when that is not finite: the last saved state is the good one."""
        study = self.study
        for group in self.optimizer.param_groups:
            group["lr"] = study.rate_at(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for row in range(study.batch):
            found = loss(self.prior, self.lessons.draw(study.seed, self.step, row, len(self.prior.schedule)))
            if not bool(torch.isfinite(found)):
                raise NumericalError(
                    f"The loss of step {self.step} is {float(found)}. Lower --lr, or use --dtype float32, and give "
                    "another -o."
                )
            (found / study.batch).backward()
            total += float(found.detach()) / study.batch
        torch.nn.utils.clip_grad_norm_(self.trained.values(), 1.0)
        self.optimizer.step()
        self.step += 1
        return total

    def run(self, folder: Path, told: Callable[[int, float], None]) -> None:
        """To the end, saving on the way; `told` hears every step and its loss."""
        while self.step < self.study.steps:
            found = self.advance()
            if self.step % self.study.save_every == 0 or self.step == self.study.steps:
                self.save(folder / STATE)
            told(self.step, found)

    @torch.no_grad()
    def exam(self) -> float:
        """Mean loss of lessons that never change, over some pictures and noise steps."""
        times = [self.prior.schedule.step(share) for share in EXAM_TIMES]
        pictures = range(min(EXAM_PICTURES, len(self.lessons.latents)))
        found = [float(loss(self.prior, self.lessons.fixed(picture, t))) for picture in pictures for t in times]
        return sum(found) / len(found)

    def save(self, path: Path) -> None:
        """What is trained, its optimizer and the step, atomically."""
        tensors: dict[str, Tensor] = {f"unet.{name}": value.detach() for name, value in self.trained.items()}
        for index, record in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in record.items()}
        meta = json.dumps({"step": self.step, "before": self.before, "study": asdict(self.study)})
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            save_file({k: v.contiguous() for k, v in tensors.items()}, temporary, metadata={"gsopt": meta})
            os.replace(temporary, path)
        except (OSError, SafetensorError) as error:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise InputError(f"Cannot write {path}: {error}. Free some space, then give the same command.") from error

    def restore(self, path: Path) -> None:
        """Inverse of `save`. InputError for another study's state or a broken file."""
        try:
            with safe_open(path, framework="pt") as file:
                meta = json.loads((file.metadata() or {})["gsopt"])
                tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
            if meta["study"] != asdict(self.study):
                raise ValueError(f"it belongs to a training with {meta['study']}")
            self._take(tensors)
            self.step, self.before = int(meta["step"]), meta["before"]
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise InputError(
                f"Cannot continue from {path} ({error}). Give the flags the training began with, or another -o."
            ) from error

    @torch.no_grad()
    def _take(self, tensors: dict[str, Tensor]) -> None:
        records: dict[int, dict[str, Any]] = {}
        for name, parameter in self.trained.items():
            parameter.copy_(tensors[f"unet.{name}"])
        for name, value in tensors.items():
            kind, index, *key = name.split(".", 2)
            if kind == "optimizer":
                records.setdefault(int(index), {})[key[0]] = value
        state = self.optimizer.state_dict()
        self.optimizer.load_state_dict({**state, "state": records})


def loss(prior: DiffusersPrior, lesson: Lesson) -> Float[Tensor, ""]:
    """Equation (1)."""
    z, eps = lesson.z.to(prior.device), lesson.eps.to(prior.device)
    signal = prior.schedule.signal(lesson.t, z)
    output = prior.unet(
        add_noise(z, eps, signal).to(prior.dtype),
        lesson.t.to(prior.device),
        encoder_hidden_states=None if lesson.tokens is None else lesson.tokens.to(prior.device, prior.dtype),
    ).sample
    return (output.float() - output_for(z, eps, signal, prior.prediction)).square().mean()
