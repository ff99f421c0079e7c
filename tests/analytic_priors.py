"""Priors whose answers are known in closed form, and one that shows what a view-conditioned pixel prior reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from gsopt.sds.noise import NoiseSchedule, Prediction, eps_from, output_for, x0_from
from gsopt.sds.priors.protocol import Condition, Encoder, Pair, Scale

STEPS = 1000
NOBODY = Pair(Condition(), Condition())


def cosine_schedule(steps: int = STEPS) -> NoiseSchedule:
    """a = cos²(pi/2 · t/T), kept off 0 and 1."""
    t = (torch.arange(steps, dtype=torch.float64) + 1) / (steps + 1)
    return NoiseSchedule.of(torch.cos(0.5 * torch.pi * t) ** 2)


@dataclass
class PixelPrior:
    """In pixel space; its answer is a function of (x_t, signal, condition). Counts its calls."""

    answer: Callable[[Tensor, Tensor, Condition], Tensor]
    prediction: Prediction = "sample"
    size: int = 16
    name: str = "toy"
    x0_limit: float | None = None
    class_embedding_width: int | None = None
    aligned: bool = True
    schedule: NoiseSchedule = field(default_factory=cosine_schedule)
    calls: list[int] = field(default_factory=list)
    """Rows of every call."""
    seen: list[Condition] = field(default_factory=list)
    words: Encoder | None = None

    def encode(self, images: Tensor) -> Tensor:
        return 2 * images - 1

    def decode(self, x0: Tensor) -> Tensor:
        return ((x0 + 1) / 2).clamp(0, 1)

    @torch.no_grad()
    def denoise(self, x_t: Tensor, t: Tensor, conditions: Sequence[Condition]) -> Tensor:
        """The answer as a network of this kind of prediction would give it, then back to x0."""
        assert len(x_t) == len(t) == len(conditions)
        self.calls.append(len(x_t))
        self.seen += conditions
        signal = self.schedule.signal(t, x_t)
        x0 = torch.stack([self.answer(x, a, c) for x, a, c in zip(x_t, signal, conditions, strict=True)])
        output = output_for(x0, eps_from(x0, x_t, signal), signal, self.prediction)
        return x0_from(output, x_t, signal, self.prediction)

    def encoder(self) -> Encoder | None:
        return self.words


def gaussian_posterior(mean: Tensor | float, std: float) -> Callable[[Tensor, Tensor, Condition], Tensor]:
    """E[x0 | x_t] for x0 ~ N(mean, std²): mean + std² sqrt(a) / (a std² + 1 - a) · (x_t - sqrt(a) mean)."""

    def answer(x_t: Tensor, signal: Tensor, condition: Condition) -> Tensor:
        gain = std**2 * signal.sqrt() / (signal * std**2 + 1 - signal)
        return mean + gain * (x_t - signal.sqrt() * mean)

    return answer


def knows(x0: Tensor) -> Callable[[Tensor, Tensor, Condition], Tensor]:
    """A denoiser that always answers the same image."""
    return lambda x_t, signal, condition: x0.to(x_t)


def scale(guidance: float = 1.0, **more: object) -> Scale:
    return replace(Scale(guidance), **more)
