"""One guided step of `gsopt train` by a diffusers folder, every part of it measured."""

from __future__ import annotations

import gc
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from tensor_meter import Meter, Phase

from gsopt.cli import main
from gsopt.raster.backend import Gradients
from gsopt.sds.guidance_step import Guidance
from gsopt.sds.priors.stable_diffusion import DiffusersPrior

FLAGS = [
    *["--iterations", "2", "--guidance.start", "0", "--guidance.stop", "1", "--guidance.every", "10"],
    *["--guidance.guard-views", "0", "--guidance.min-uncertainty", "0", "--init", "random", "--init-count", "200"],
    *["--backend", "cpu", "--threads", "1", "--checkpoint-every", "0", "--preview-every", "0"],
]


@dataclass
class Step:
    """Measurements of a step."""

    code: int = -1
    phases: list[Phase] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    """Rows of every call of the U-Net."""
    gradients: list[Gradients] = field(default_factory=list)
    weights: dict[str, int] = field(default_factory=dict)
    """Bytes of each network."""
    text_encoders: int = 0
    """Alive when the U-Net was called."""
    cpu_seconds: float = 0.0
    """Peak of the guided step."""
    peak_rss: int = 0


def guided_step(folder: Path, scene: Path, run: Path, *flags: str) -> Step:
    """Train two steps, the first of them guided."""
    seen = Step()
    with pytest.MonkeyPatch.context() as patch, Meter() as meter:
        _watch(patch, meter, seen)
        seen.code = main(["train", str(scene), "-m", str(run), "--prior", str(folder), *FLAGS, *flags])
        seen.phases = meter.phases
    scale = 1 if sys.platform == "darwin" else 1024
    seen.peak_rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale
    return seen


def _watch(patch: pytest.MonkeyPatch, meter: Meter, seen: Step) -> None:
    def measured(owner: Any, name: str, before: Callable[..., None]) -> None:
        inner = getattr(owner, name)

        def outer(*args: Any, **kwargs: Any) -> Any:
            before(*args)
            with meter.phase(name):
                return inner(*args, **kwargs)

        patch.setattr(owner, name, outer)

    def vae(prior: DiffusersPrior, *_: Any) -> None:
        seen.weights["vae"] = size(prior.vae)

    def unet(prior: DiffusersPrior, x_t: torch.Tensor, *_: Any) -> None:
        seen.weights["unet"] = size(prior.unet)
        seen.rows.append(len(x_t))
        gc.collect()
        seen.text_encoders += sum(type(thing).__name__ == "CLIPTextModel" for thing in gc.get_objects())

    measured(DiffusersPrior, "encode", vae)
    measured(DiffusersPrior, "decode", vae)
    measured(DiffusersPrior, "denoise", unet)
    measured(torch.autograd, "grad", lambda *_: None)
    inner = Guidance.gradients

    def gradients(self: Guidance, *args: Any) -> Gradients | None:
        began = time.process_time()
        found = inner(self, *args)
        if found is not None:
            seen.cpu_seconds = time.process_time() - began
            seen.gradients.append(found)
        return found

    patch.setattr(Guidance, "gradients", gradients)


def size(network: torch.nn.Module) -> int:
    """Bytes of the weights."""
    return sum(value.numel() * value.element_size() for value in network.parameters())
