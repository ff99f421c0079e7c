"""Selects the prior of a run and gives the reason. No torch: the command line calls this before it reads any data."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from gsopt.config.guidance import GuidanceConfig, chooses_itself, completes_bodies, shape_prior_of
from gsopt.errors import UsageError

DEFAULT_WEIGHT = 0.2
EMBEDDED = Path(__file__).with_name("embedded")
"""The embedded prior's folder, written by `gsopt finetune`."""
NOT_ASKED = f"nobody asked for a prior (`--lambda_sds {DEFAULT_WEIGHT}`, `--prior` or words do)"
"""The one that ships never gained more than chance where nobody asked (docs/decisions/0010-prior-on-request.md)."""
NO_WEIGHTS = "this copy of gsopt carries no prior; name one with --prior sd21, a folder or a hub id"
LIBRARY = "a shape library completes the first shape and guides no step"
SHAPE = "a shape prior completes the first shape and guides no step"
NO_DIFFUSERS = "the embedded prior needs diffusers: pip install 'gsopt[sds]'"


@dataclass(frozen=True)
class PriorSelection:
    """The selected prior, displayed to the user and saved with the run."""

    name: str | None
    """Name of the prior; `None` = no guidance."""
    weight: float
    """Value of lambda_sds before the guard."""
    reason: str


def select_prior(config: GuidanceConfig, completed: bool = False) -> PriorSelection:
    """Selects prior and weight of a new run; `completed`: a library or a shape prior has found a body for its photos.

    Raises UsageError when guidance is requested and no prior is available.
    """
    if config.lambda_sds == 0:
        return PriorSelection(None, 0.0, "lambda_sds is 0")
    if completes_bodies(config.prior) or (completed and chooses_itself(config)):
        return PriorSelection(None, 0.0, LIBRARY if shape_prior_of(config.prior) is None else SHAPE)
    requests = guidance_flags(config)
    if not requests:
        return PriorSelection(None, 0.0, NOT_ASKED)
    weight, reason = config.lambda_sds or DEFAULT_WEIGHT, f"as asked for with {requests[0]}"
    if config.prior not in ("auto", "embedded"):
        return PriorSelection(config.prior, weight, reason)
    if missing := embedded_prior_obstacle():
        raise UsageError(
            f"`{requests[0]}` asks for guidance, but there is no prior at hand: {missing}. Or drop the flag to learn "
            "from the images alone; `--prior library` completes one photo of an object without it."
        )
    return PriorSelection("embedded", weight, reason)


def guidance_flags(config: GuidanceConfig) -> list[str]:
    """Returns the given flags that ask for guidance."""
    flags = (
        (f"--prior {config.prior}", config.prior != "auto"),
        (f"--lambda_sds {config.lambda_sds}", config.lambda_sds is not None),
        ("--prompt", config.prompt or config.negative or config.prompts),
        ("--ref-image", config.ref_image),
    )
    return [flag for flag, given in flags if given]


def embedded_prior_obstacle() -> str | None:
    """Returns the reason why the embedded prior is unavailable, or None."""
    if not (EMBEDDED / "unet" / "config.json").is_file():
        return NO_WEIGHTS
    return None if importlib.util.find_spec("diffusers") else NO_DIFFUSERS
