"""The forward process of a diffusion model, what its network predicts, and the weights w(t).

With a = alphas_cumprod[t] (Ho et al. 2020; "signal" below):

    (1)  x_t = sqrt(a) x0 + sqrt(1-a) eps
    (2)  v   = sqrt(a) eps - sqrt(1-a) x0                  (Salimans & Ho 2022)

so that each of x0, eps and v gives the others once x_t is known. SD 2.1 at 768 px predicts v, its base model eps, the
embedded prior x0; all modules above this one use x0 only.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt import check
from gsopt.errors import InputError

Prediction = Literal["epsilon", "v_prediction", "sample"]
"""Kind of the network's output, as diffusers' scheduler_config.json names it."""
PREDICTIONS: tuple[str, ...] = get_args(Prediction)

Latents = Float[Tensor, "B C h w"]
Signal = Float[Tensor, "B 1 1 1"]
"""alphas_cumprod of every row's step."""


@dataclass(frozen=True)
class NoiseSchedule:
    """Share of the signal in x_t at each of a model's T steps."""

    alphas_cumprod: Float[Tensor, "T"]
    """Falling, in [0, 1]; float64 on the CPU."""

    def __len__(self) -> int:
        return len(self.alphas_cumprod)

    def signal(self, t: Int[Tensor, "B"], like: Tensor) -> Signal:
        """Returns a of every row, on the device and in the type of `like`."""
        return self.alphas_cumprod[t.cpu()].view(-1, 1, 1, 1).to(like)

    def step(self, share: float) -> int:
        """Returns the step at a share of the process: 0 is (almost) clean, 1 all noise."""
        return min(len(self) - 1, max(0, math.floor(share * len(self))))

    @staticmethod
    def of(alphas_cumprod: Tensor) -> NoiseSchedule:
        """Checks the values; raises InputError for an invalid noise schedule."""
        values = alphas_cumprod.detach().double().cpu()
        check.shape("alphas_cumprod", values, (None,))
        check.finite("alphas_cumprod", values)
        if len(values) < 2 or bool((values.diff() > 0).any()) or values[0] > 1 or values[-1] < 0:
            raise InputError(
                f"`alphas_cumprod` must fall from at most 1 to at least 0, got {len(values)} values from "
                f"{float(values[0]) if len(values) else 'none'}. Restore the model's scheduler_config.json."
            )
        return NoiseSchedule(values)


def add_noise(x0: Latents, eps: Latents, signal: Signal) -> Latents:
    """Equation (1)."""
    return signal.sqrt() * x0 + (1 - signal).sqrt() * eps


def x0_from(output: Latents, x_t: Latents, signal: Signal, prediction: Prediction) -> Latents:
    """Returns x0 from a network's output: (1) and (2) solved for x0."""
    if prediction == "sample":
        return output
    if prediction == "v_prediction":
        return signal.sqrt() * x_t - (1 - signal).sqrt() * output
    return (x_t - (1 - signal).sqrt() * output) / signal.sqrt()


def output_for(x0: Latents, eps: Latents, signal: Signal, prediction: Prediction) -> Latents:
    """Returns the training target of a network of this kind."""
    if prediction == "sample":
        return x0
    return eps if prediction == "epsilon" else signal.sqrt() * eps - (1 - signal).sqrt() * x0


def eps_from(x0: Latents, x_t: Latents, signal: Signal) -> Latents:
    """Returns the noise between x0 and x_t: (1) solved for eps."""
    return (x_t - signal.sqrt() * x0) / (1 - signal).sqrt()


def weight(kind: str, signal: Signal) -> Signal:
    """w(t) of score distillation.

    sigma2: 1-a (Poole et al. 2022); fantasia: sqrt(a)(1-a) (Chen et al. 2023); one: 1; x0: sqrt((1-a)/a), for which
    w (eps_hat - eps) = x0 - x0_hat.
    """
    if kind == "sigma2":
        return 1 - signal
    if kind == "fantasia":
        return signal.sqrt() * (1 - signal)
    return torch.ones_like(signal) if kind == "one" else ((1 - signal) / signal).sqrt()


def generator(seed: int, step: int, view: int, purpose: str) -> torch.Generator:
    """A CPU generator that depends on nothing but its arguments: a resumed run draws the same numbers."""
    digest = hashlib.blake2b(f"{seed}/{step}/{view}/{purpose}".encode(), digest_size=8).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest, "little") >> 1)
