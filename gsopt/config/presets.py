"""Three sets of settings for little, some and much time (docs/performance.md). Any flag that is given wins."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

T = TypeVar("T")
Preset = Literal["draft", "default", "high"]

PRESETS: dict[str, dict[str, Any]] = {
    "draft": {"iterations": 2000, "schedule": {"crop_masked": True, "rest_converged": True, "stop_when_flat": True}},
    "default": {},
    "high": {"iterations": 15_000},
}
"""Settings of each preset that differ from the defaults of TrainConfig."""


def with_preset(record: T, name: str) -> T:
    """A dataclass with the fields of a preset replaced, those of its parts included, and `preset` set to its name."""
    return _replaced(record, {**PRESETS[name], "preset": name})


def _replaced(record: T, values: Mapping[str, Any]) -> T:
    new = {
        key: _replaced(getattr(record, key), value) if isinstance(value, Mapping) else value
        for key, value in values.items()
    }
    return dataclasses.replace(record, **new)  # type: ignore[type-var]


def chosen(argv: Sequence[str]) -> str:
    """The preset that command line arguments name, before they are parsed: `default` where they name none."""
    name = "default"
    for flag, following in itertools.zip_longest(argv, argv[1:], fillvalue=""):
        given = following if flag == "--preset" else flag.removeprefix("--preset=")
        if given != flag and given in PRESETS:
            name = given
    return name
