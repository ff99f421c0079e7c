"""The settings of guidance, resolved for a run and a kind of prior: the steps it guides and the noise it uses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.background import Background

T = TypeVar("T")


@dataclass(frozen=True)
class GuidancePlan:
    """`GuidanceConfig` with nothing left open; fields of the same names mean the same."""

    policy: str
    guidance_scale: float
    rescale: float
    sequential: bool
    weighting: str
    clip_rms: float
    t_min: float
    t_max: float
    t_max_end: float
    anneal: str
    first_step: int
    """First step that may be guided: the warm-up lies before it."""
    last_step: int
    """Last step that may be guided."""
    every: int
    min_uncertainty: float
    certain_weight: float
    geometry: float
    denoise_steps: int
    refresh_every: int
    inversion_steps: int
    references: int
    front_named: bool
    """True when the user named the view that shows the front."""
    seed: int
    background: Background

    @staticmethod
    def of(
        config: GuidanceConfig, iterations: int, seed: int, background: Background, *, view_conditioned: bool
    ) -> GuidancePlan:
        """Resolves the settings for a prior of this kind."""
        scale, denoise_steps, certain, least = (1.0, 1, 1.0, 0.0) if view_conditioned else (3.0, 5, 0.0, 0.05)
        return GuidancePlan(
            policy=resolved_policy(config, view_conditioned),
            guidance_scale=_or_default(config.guidance_scale, scale),
            rescale=config.rescale,
            sequential=config.sequential,
            weighting=config.weighting,
            clip_rms=config.clip_rms,
            t_min=config.t_min,
            t_max=config.t_max,
            t_max_end=config.t_max_end,
            anneal=config.anneal,
            first_step=max(1, math.ceil(config.start * iterations)),
            last_step=math.floor(config.stop * iterations),
            every=resolved_every(config, view_conditioned),
            min_uncertainty=_or_default(config.min_uncertainty, least),
            certain_weight=_or_default(config.certain_weight, certain),
            geometry=config.geometry,
            denoise_steps=_or_default(config.denoise_steps, denoise_steps),
            refresh_every=config.refresh_every,
            inversion_steps=config.inversion_steps,
            references=config.references,
            front_named=config.front_view is not None,
            seed=seed,
            background=background,
        )

    def is_guided(self, step: int) -> bool:
        """True when the schedule plans guidance in this step; coverage may still decide against it."""
        return self.first_step <= step <= self.last_step and (step - self.first_step) % self.every == 0

    @property
    def guided_steps(self) -> int:
        """Number of steps that the schedule plans to guide."""
        return 0 if self.last_step < self.first_step else (self.last_step - self.first_step) // self.every + 1

    def noise_range(self, step: int) -> tuple[float, float]:
        """(least, most) noise as shares of the process; the most falls from t_max to t_max_end while guidance lasts.

        Late renders are near the mode, and much noise would forget what the inputs taught (sqrt: falls fast at first).
        """
        progress = min(1.0, max(0.0, (step - self.first_step) / max(1, self.last_step - self.first_step)))
        fall = math.sqrt(progress) if self.anneal == "sqrt" else progress
        return self.t_min, self.t_max + (self.t_max_end - self.t_max) * fall


@dataclass(frozen=True)
class GuidancePlans:
    """A run's guidance for either kind of prior: which one it gets is known only once the prior is open."""

    text_to_image: GuidancePlan
    view_conditioned: GuidancePlan

    @staticmethod
    def of(config: GuidanceConfig, iterations: int, seed: int, background: Background) -> GuidancePlans:
        text, view = (
            GuidancePlan.of(config, iterations, seed, background, view_conditioned=kind) for kind in (False, True)
        )
        return GuidancePlans(text, view)

    def for_prior(self, view_conditioned: bool) -> GuidancePlan:
        return self.view_conditioned if view_conditioned else self.text_to_image


def resolved_policy(config: GuidanceConfig, view_conditioned: bool) -> str:
    """The policy that suits the prior, unless one is given."""
    return config.policy if config.policy != "auto" else "recon" if view_conditioned else "sds"


def resolved_every(config: GuidanceConfig, view_conditioned: bool) -> int:
    """Steps between two guided ones: targets of recon last, so that it may act often."""
    return _or_default(config.every, 2 if resolved_policy(config, view_conditioned) == "recon" else 10)


def _or_default(value: T | None, default: T) -> T:
    return default if value is None else value
