"""Which steps are guided, and how much noise they look through: pure functions of the configuration."""

from __future__ import annotations

import math

from gsopt.config.guidance import GuidanceConfig, sure

# Configurations here are settled ones (`guidance_config.settled`): nothing in them is left open.


def first_step(config: GuidanceConfig, iterations: int) -> int:
    """First step that may be guided: the warm-up lies before it."""
    return max(1, math.ceil(config.start * iterations))


def last_step(config: GuidanceConfig, iterations: int) -> int:
    """Last step that may be guided."""
    return math.floor(config.stop * iterations)


def is_guided(step: int, config: GuidanceConfig, iterations: int) -> bool:
    """Whether the schedule wants guidance in this step; coverage may still decide against it."""
    first = first_step(config, iterations)
    return first <= step <= last_step(config, iterations) and (step - first) % sure(config.every) == 0


def guided_steps(config: GuidanceConfig, iterations: int) -> int:
    """How many steps the schedule wants guided."""
    first, last = first_step(config, iterations), last_step(config, iterations)
    return 0 if last < first else (last - first) // sure(config.every) + 1


def noise_range(step: int, config: GuidanceConfig, iterations: int) -> tuple[float, float]:
    """(least, most) noise as shares of the process; the most falls from t_max to t_max_end while guidance lasts.

    Late renders are near the mode, and much noise would forget what the inputs taught (sqrt: falls fast at first).
    """
    first, last = first_step(config, iterations), last_step(config, iterations)
    progress = min(1.0, max(0.0, (step - first) / max(1, last - first)))
    fall = math.sqrt(progress) if config.anneal == "sqrt" else progress
    return config.t_min, config.t_max + (config.t_max_end - config.t_max) * fall
