"""Values of a run's files as the page displays them; the files are not trusted."""

from __future__ import annotations

from gsopt.config.from_json import MAX_JSON_NUMBER
from gsopt.errors import shortened


def number(value: object) -> float | None:
    """A finite number, or None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_JSON_NUMBER:
        return None
    return float(value)


def text(value: object) -> str:
    """A string as it stands; anything else shortened, because lists may be nested too deeply for `str`."""
    return value if isinstance(value, str) else shortened(value)
