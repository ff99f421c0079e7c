"""Which prior a run takes, and why. No torch: the command line asks this before it reads any data."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import UsageError

DEFAULT_WEIGHT = 0.2
EMBEDDED = Path(__file__).with_name("embedded")
"""The embedded prior's folder, written by `gsopt finetune`."""
ENOUGH_VIEWS = 6
"""The guard never let the embedded prior guide a run with so many or more: its answers to left-out views of the `val`
objects were -0.11 to +0.08 dB better than the renders with six, where 0.5 are asked for. Asking takes a quarter of
such a run's time."""
NO_WEIGHTS = "this copy of gsopt carries no prior; name one with --prior sd21, a folder or a hub id"
NO_DIFFUSERS = "the embedded prior needs diffusers: pip install 'gsopt[sds]'"


@dataclass(frozen=True)
class Choice:
    """Said to the user and kept with the run."""

    prior: str | None
    """None: no guidance."""
    weight: float
    """lambda_sds, before the guard."""
    reason: str


def choose(config: GuidanceConfig) -> Choice:
    """The prior and the weight of a new run. UsageError where guidance was asked for and there is no prior."""
    if config.lambda_sds == 0:
        return Choice(None, 0.0, "lambda_sds is 0")
    weight = DEFAULT_WEIGHT if config.lambda_sds is None else config.lambda_sds
    if config.prior not in ("auto", "embedded"):
        return Choice(config.prior, weight, "as asked for with --prior")
    missing = what_embedded_lacks()
    if missing is None:
        return Choice("embedded", weight, "the embedded prior" + (" (default)" if config.prior == "auto" else ""))
    asked = asking(config)
    if asked:
        raise UsageError(
            f"`{asked[0]}` asks for guidance, but there is no prior at hand: {missing}. Or drop the flag to learn from "
            "the images alone."
        )
    return Choice(None, 0.0, f"no prior at hand: {missing}")


def asking(config: GuidanceConfig) -> list[str]:
    """The flags that ask for guidance by the embedded prior."""
    flags = (
        ("--prior embedded", config.prior == "embedded"),
        (f"--lambda_sds {config.lambda_sds}", config.lambda_sds is not None),
        ("--prompt", config.prompt or config.negative or config.prompts),
        ("--ref-image", config.ref_image),
    )
    return [flag for flag, given in flags if given]


def fitting(choice: Choice, config: GuidanceConfig, views: int, has_alpha: bool) -> Choice:
    """The choice for a scene of so many input views. Guidance that nobody asked for is left where it cannot help:
    ENOUGH_VIEWS decide by themselves, and the embedded prior knows objects cut out of their background."""
    if choice.prior != "embedded" or asking(config):
        return choice
    if views >= ENOUGH_VIEWS:
        return Choice(None, 0.0, f"{views} input views decide by themselves; --lambda_sds {DEFAULT_WEIGHT} asks for it")
    if not has_alpha:
        why = (
            "the embedded prior knows objects with alpha or masks, which this scene lacks; --prior embedded asks for it"
        )
        return Choice(None, 0.0, why)
    return choice


def what_embedded_lacks() -> str | None:
    """Why the embedded prior cannot be used here; None where it can."""
    if not (EMBEDDED / "unet" / "config.json").is_file():
        return NO_WEIGHTS
    return None if importlib.util.find_spec("diffusers") else NO_DIFFUSERS
