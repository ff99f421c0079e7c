"""Which prior a run takes, and why. No torch: the command line asks this before it reads any data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsopt.errors import UsageError
from gsopt.guidance_config import GuidanceConfig

DEFAULT_WEIGHT = 0.2
EMBEDDED = Path(__file__).with_name("embedded")
"""Where the embedded prior's diffusers folder lies once there is one."""
NONE_AT_HAND = "no prior at hand: this version of gsopt carries none; name one with --prior sd21, a folder or a hub id"


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
    if is_embedded_shipped():
        return Choice("embedded", weight, "the embedded prior" + (" (default)" if config.prior == "auto" else ""))
    asked = [
        flag
        for flag, given in (
            ("--prior embedded", config.prior == "embedded"),
            (f"--lambda_sds {config.lambda_sds}", config.lambda_sds is not None),
            ("--prompt", config.prompt or config.negative or config.prompts),
            ("--ref-image", config.ref_image),
        )
        if given
    ]
    if asked:
        raise UsageError(
            f"`{asked[0]}` asks for guidance, but there is {NONE_AT_HAND}. Or drop the flag to learn from the images "
            "alone."
        )
    return Choice(None, 0.0, NONE_AT_HAND)


def is_embedded_shipped() -> bool:
    """Whether this version of gsopt carries a prior of its own."""
    return (EMBEDDED / "unet" / "config.json").is_file()
