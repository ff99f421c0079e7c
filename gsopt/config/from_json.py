"""Reads frozen dataclasses from parsed JSON; unknown keys and wrong types raise InputError with the key's name."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, Literal, TypeVar

from gsopt.errors import InputError, shortened

T = TypeVar("T")

MAX_JSON_NUMBER = 1e300
"""Bound on every number of a file: whole numbers may be longer than a float holds, and sums must not overflow."""


def build(cls: type[T], values: object, where: str) -> T:
    """An instance of a dataclass whose sections are dataclasses too; `where` is the name of `values` in errors."""
    if not isinstance(values, dict):
        raise InputError(f"`{where}` must be an object, got {type(values).__name__}. See `gsopt train --help`.")
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise InputError(f"Unknown key `{where}.{unknown[0]}`. Known keys: {', '.join(hints)}.")
    return cls(**{key: _convert(hints[key], value, f"{where}.{key}") for key, value in values.items()})


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return build(hint, value, where)  # type: ignore[arg-type]
    if _matches(hint, value):
        return tuple(value) if isinstance(value, list) else value
    name = getattr(hint, "__name__", str(hint))
    raise InputError(f"`{where}` must be {name}, got {shortened(value)}. Correct it or remove the key for the default.")


def _matches(hint: Any, value: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in args
    if origin in (types.UnionType, typing.Union):
        return any(_matches(arg, value) for arg in args)
    if origin is tuple:
        return isinstance(value, (list, tuple)) and all(_matches(args[0], item) for item in value)
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < MAX_JSON_NUMBER
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return value is None if hint is type(None) else isinstance(value, hint)
