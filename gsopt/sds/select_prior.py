"""Selects the prior of a run and gives the reason. No torch: the command line calls this before it reads any data."""

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
"""From this number of input views on, the guard never admitted the embedded prior: on left-out views of the `val`
objects its predictions gained -0.11 to +0.08 dB over the renders with six views, and the guard requires 0.5 dB. The
guard takes a quarter of such a run's time."""
NO_WEIGHTS = "this copy of gsopt carries no prior; name one with --prior sd21, a folder or a hub id"
NO_DIFFUSERS = "the embedded prior needs diffusers: pip install 'gsopt[sds]'"


@dataclass(frozen=True)
class PriorSelection:
    """The selected prior, displayed to the user and saved with the run."""

    prior: str | None
    """Name of the prior; `None` = no guidance."""
    weight: float
    """Value of lambda_sds before the guard."""
    reason: str


def select_prior(config: GuidanceConfig) -> PriorSelection:
    """Selects prior and weight of a new run. Raises UsageError when guidance is requested and no prior is available."""
    if config.lambda_sds == 0:
        return PriorSelection(None, 0.0, "lambda_sds is 0")
    weight = DEFAULT_WEIGHT if config.lambda_sds is None else config.lambda_sds
    if config.prior not in ("auto", "embedded"):
        return PriorSelection(config.prior, weight, "as asked for with --prior")
    missing = embedded_prior_obstacle()
    if missing is None:
        return PriorSelection(
            "embedded", weight, "the embedded prior" + (" (default)" if config.prior == "auto" else "")
        )
    asked = guidance_flags(config)
    if asked:
        raise UsageError(
            f"`{asked[0]}` asks for guidance, but there is no prior at hand: {missing}. Or drop the flag to learn from "
            "the images alone."
        )
    return PriorSelection(None, 0.0, f"no prior at hand: {missing}")


def guidance_flags(config: GuidanceConfig) -> list[str]:
    """Returns the given flags that request guidance by the embedded prior."""
    flags = (
        ("--prior embedded", config.prior == "embedded"),
        (f"--lambda_sds {config.lambda_sds}", config.lambda_sds is not None),
        ("--prompt", config.prompt or config.negative or config.prompts),
        ("--ref-image", config.ref_image),
    )
    return [flag for flag, given in flags if given]


def restrict_to_scene(choice: PriorSelection, config: GuidanceConfig, views: int, has_alpha: bool) -> PriorSelection:
    """Drops guidance that was not requested if it cannot help this scene: with ENOUGH_VIEWS or more input views, or
    without alpha, because the embedded prior is trained on objects without background."""
    if choice.prior != "embedded" or guidance_flags(config):
        return choice
    if views >= ENOUGH_VIEWS:
        return PriorSelection(
            None, 0.0, f"{views} input views decide by themselves; --lambda_sds {DEFAULT_WEIGHT} asks for it"
        )
    if not has_alpha:
        why = (
            "the embedded prior knows objects with alpha or masks, which this scene lacks; --prior embedded asks for it"
        )
        return PriorSelection(None, 0.0, why)
    return choice


def embedded_prior_obstacle() -> str | None:
    """Returns the reason why the embedded prior is unavailable, or None."""
    if not (EMBEDDED / "unet" / "config.json").is_file():
        return NO_WEIGHTS
    return None if importlib.util.find_spec("diffusers") else NO_DIFFUSERS
