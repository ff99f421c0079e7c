"""Trains a network: AdamW, averaged weights, resumable bit for bit; a view-conditioned prior by least squares."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsopt.errors import InputError, NumericalError
from gsopt.events import write_atomic
from gsopt.finetune.batches import Batch, draw_batch
from gsopt.finetune.caption_tokens import SceneCaptions
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.finetune.training_config import PriorTrainingConfig, TrainingConfig
from gsopt.sds.noise import generator
from gsopt.sds.priors.view_conditioned import cosine_schedule, predict

EDGE_WEIGHT = 0.1
"""Weight of the error of the image gradients, against blur."""
STATE = "training.safetensors"
Data = TypeVar("Data")


class AveragedTrainer(Generic[Data]):
    """Network, averaged weights and optimizer of one training."""

    def __init__(self, unet: Any, config: TrainingConfig) -> None:
        self.unet, self.config, self.step = unet.train(), config, 0
        self.average = {name: value.detach().clone() for name, value in unet.state_dict().items()}
        self.optimizer = torch.optim.AdamW(
            unet.parameters(), lr=config.lr, weight_decay=config.weight_decay, betas=(0.9, 0.99), fused=True
        )

    def loss(self, data: Data) -> Tensor:
        """The loss of a batch that depends on nothing but the data, the seed and the step."""
        raise NotImplementedError

    def advance(self, data: Data) -> float:
        """Takes one step and returns its loss. Raises NumericalError when it is not finite; the last saved state is
        valid."""
        found = self.loss(data)
        if not bool(torch.isfinite(found)):
            raise NumericalError(f"The loss of step {self.step} is {float(found)}. Lower --lr and run again.")
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.rate(self.step)
        self.optimizer.zero_grad(set_to_none=True)
        found.backward()
        torch.nn.utils.clip_grad_norm_(self.unet.parameters(), 1.0)
        self.optimizer.step()
        self.step += 1
        decay = min(self.config.ema, self.step / (self.step + 10))
        with torch.no_grad():
            for name, value in self.unet.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        return float(found.detach())

    def run(self, data: Data, folder: Path, on_step: Callable[[int, float], None], until: float = math.inf) -> None:
        """Trains to the last step, or to the time `until` on the monotonic clock, and saves regularly; calls `on_step`
        with every step and its loss."""
        while self.step < self.config.steps and time.monotonic() < until:
            found = self.advance(data)
            on_step(self.step, found)
            late = time.monotonic() >= until
            if self.step % self.config.save_every == 0 or self.step == self.config.steps or late:
                self.save(folder / STATE)

    def save(self, path: Path) -> None:
        tensors: dict[str, Tensor] = {f"average.{name}": value for name, value in self.average.items()}
        tensors |= {f"unet.{name}": value for name, value in self.unet.state_dict().items()}
        moments = self.optimizer.state_dict()["state"]
        for index, record in moments.items():
            tensors |= {f"optimizer.{index}.{name}": torch.as_tensor(value) for name, value in record.items()}
        meta = json.dumps({"step": self.step, "course": asdict(self.config)})
        write_atomic(path, save({k: v.contiguous() for k, v in tensors.items()}, metadata={"gsopt": meta}))

    def restore(self, path: Path) -> None:
        """Inverse of `save`. Raises InputError for the state of another configuration or a broken file."""
        try:
            with safe_open(path, framework="pt") as file:
                meta = json.loads((file.metadata() or {})["gsopt"])
                # Cloned: in the file they may be unaligned, where matrix products round differently.
                tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
            if meta["course"] != json.loads(json.dumps(asdict(self.config))):
                raise ValueError(f"it belongs to a training with {meta['course']}")
            self.unet.load_state_dict(_part(tensors, "unet."))
            for name, value in _part(tensors, "average.").items():
                self.average[name].copy_(value)
            records: dict[int, dict[str, Tensor]] = {}
            for name, value in _part(tensors, "optimizer.").items():
                index, key = name.split(".", 1)
                records.setdefault(int(index), {})[key] = value
            state = self.optimizer.state_dict()
            self.optimizer.load_state_dict({**state, "state": records})
            self.step = int(meta["step"])
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
            raise InputError(
                f"Cannot continue from {path} ({error}). Give the flags the training began with, or another -o."
            ) from error

    def use_average(self) -> Any:
        """Loads the averaged weights and returns the network in evaluation mode."""
        own = {name: value.clone() for name, value in self.unet.state_dict().items()}
        self.unet.load_state_dict(self.average)
        self._trained_weights = own
        return self.unet.eval()

    def use_trained(self) -> None:
        """Loads the trained weights again after `use_average`."""
        self.unet.load_state_dict(self._trained_weights)
        self.unet.train()


class PriorTrainer(AveragedTrainer[Pairs]):
    """Training of a view-conditioned prior."""

    def __init__(self, unet: Any, config: PriorTrainingConfig, captions: SceneCaptions | None = None) -> None:
        super().__init__(unet, config)
        self.captions, self.noise = captions, cosine_schedule()

    def loss(self, data: Pairs) -> Tensor:
        random = generator(self.config.seed, self.step, 0, "lessons")
        return loss(self.unet, draw_batch(data, self.config.batch, self.noise, random, self.captions))


def loss(unet: Any, batch: Batch) -> Tensor:
    """Returns the weighted mean over the batch of the squared error of x0_hat and the absolute error of its
    gradients."""
    error = predict(unet, batch.x_t, batch.t, batch.planes, batch.said) - batch.x0
    inside = (1, 2, 3)
    edges = error.diff(dim=-1).abs().mean(inside) + error.diff(dim=-2).abs().mean(inside)
    return (batch.weight * (error.square().mean(inside) + EDGE_WEIGHT * edges)).mean()


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
