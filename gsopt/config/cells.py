"""Settings of a scene that is learned in cells, and of the run of one cell. No torch."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gsopt.errors import SettingError, shortened

MAX_CELLS = 999
AUTO = "auto"


@dataclass(frozen=True)
class CellConfig:
    """A part of a larger scene as a run of its own; `--cells` makes such runs."""

    start: str = ""
    """Splat file whose splats are the first Gaussians, instead of `--init`."""
    frozen: str = ""
    """Splat file that is drawn with the Gaussians and stays as it is: what lies around them."""
    views: tuple[str, ...] = ()
    """Names of the input views that the run learns from; all by default."""


def check_cells(text: str) -> None:
    """Raises SettingError unless `text` is empty, auto or a number of cells."""
    if text in ("", AUTO) or (re.fullmatch(r"[0-9]{1,3}", text) and int(text) > 1):
        return
    raise SettingError(f"`cells` must be auto or a number from 2 to {MAX_CELLS}, got {shortened(text)}. Try auto.")
