"""Checks at the border: each raises an error that states what was wrong, what was given and what to do."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from gsopt.errors import InputError, SettingError, UsageError, shortened

if TYPE_CHECKING:
    from torch import Tensor

MAX_THREADS = 1024
UNITS = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12}
DEVICE = re.compile(r"(?:(cpu|cuda|mps)(?::\d{1,3})?)?")


@dataclass(frozen=True)
class Within:
    """Bounds of a setting, both included: `lr_last: Annotated[float, Within(1e-6, 1)] = 0.1`."""

    low: float
    high: float = math.inf

    def __str__(self) -> str:
        return f"be at least {self.low}" if math.isinf(self.high) else f"lie in [{self.low}, {self.high}]"


def fields(settings: Any, section: str = "") -> None:
    """Raise SettingError for the first field outside the bounds or choices of its type; an open setting (None) passes.

    `section` is the name of these settings in config.json.
    """
    hints = _hints(type(settings))  # type: ignore[arg-type]
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if requirement := _broken(hints[field.name], value):
            name = f"{section}.{field.name}" if section else field.name
            default = "" if field.default is None else f" of {field.default}"
            raise SettingError(
                f"`{name}` must {requirement}, got {shortened(value)}. Leave it out for the default{default}."
            )


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def _broken(hint: Any, value: Any) -> str:
    """The first requirement of a type hint that the value breaks; empty when there is none."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if value is None:
        return ""
    if origin in (types.UnionType, typing.Union):
        return next(filter(None, (_broken(arg, value) for arg in args)), "")
    if origin is Literal:
        return "" if value in args else f"be one of {', '.join(args)}"
    if origin is Annotated:
        return next((str(bound) for bound in args[1:] if not bound.low <= value <= bound.high), "")
    return ""


def device(value: object) -> str:
    """The kind of a device: "cpu", "cuda", "mps", or empty where it is open. Raises SettingError for anything else."""
    match = DEVICE.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        raise SettingError(f"`device` must be cpu, cuda, mps or a GPU as cuda:1, got {shortened(value)}. Leave it out.")
    return match[1] or ""


def at_least(name: str, value: float, minimum: float, remedy: str) -> None:
    """Raise UsageError unless `value` is a number >= `minimum`; `remedy` is the advice at the end of the message."""
    if not value >= minimum:
        raise UsageError(f"`{name}` must be at least {minimum}, got {value}. {remedy}")


def within(name: str, value: float, low: float, high: float, remedy: str) -> None:
    """Raise UsageError unless `low` <= `value` <= `high` (NaN is refused)."""
    if not (low <= value <= high) or math.isnan(value):
        raise UsageError(f"`{name}` must lie in [{low}, {high}], got {value}. {remedy}")


def byte_count(name: str, text: str) -> int:
    """Bytes of a size as 8GB, 500MB or 8e9; UsageError for anything else."""
    match = re.fullmatch(r"([0-9.]{1,12}(?:e[0-9]{1,2})?) *([kMGT]?B?)", text)
    try:
        size = float(match[1]) * UNITS[match[2].rstrip("B")] if match else 0.0
    except ValueError:
        size = 0.0
    if not 1 <= size < 1e18:
        raise UsageError(f"`{name}` must be a size as 8GB or 500MB, got {shortened(text)}. Give number and unit.")
    return round(size)


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise UsageError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise UsageError(f"`{name}` must be one of {', '.join(allowed)}; got {shortened(value)}. Pick one of these.")


def finite(name: str, tensor: Tensor, largest: float = math.inf) -> None:
    """Raise InputError naming the first element of `tensor` that is NaN, infinite or beyond `largest` in magnitude."""
    import torch

    if tensor.numel() == 0:
        return
    lowest, highest = (bound.item() for bound in tensor.aminmax())  # either is NaN where any element is
    if math.isfinite(lowest) and math.isfinite(highest) and max(-lowest, highest) <= largest:
        return
    good = torch.isfinite(tensor) & (tensor.abs() <= largest)
    index = tuple(torch.nonzero(~good)[0].tolist())
    got = tensor[index].item()
    limit = "" if math.isinf(largest) else f" and within {largest:.3g}"
    raise InputError(f"`{name}` must be finite{limit}, got {got} at index {list(index)}. Remove or repair that row.")


def instance(name: str, value: object, kind: type) -> None:
    """Raise InputError unless the value is of this type."""
    if not isinstance(value, kind):
        raise InputError(f"`{name}` must be of type {kind.__name__}, got {type(value).__name__}. Convert it first.")


def dense(name: str, value: object) -> None:
    """Raise InputError unless the value is a dense tensor of floats with an axis at least."""
    import torch

    instance(name, value, torch.Tensor)
    assert isinstance(value, torch.Tensor)
    if value.layout != torch.strided or not value.is_floating_point() or value.ndim == 0:
        got = f"{value.dtype}, {value.layout}, {value.ndim} axes"
        raise InputError(f"`{name}` must be a dense tensor of floats, got {got}. Use to_dense() or float() first.")


def shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    """Raise InputError unless the tensor's shape is `expected` (None = any extent)."""
    got = tuple(tensor.shape)
    if len(got) != len(expected) or any(e is not None and e != g for e, g in zip(expected, got, strict=True)):
        want = "[" + ", ".join("?" if e is None else str(e) for e in expected) + "]"
        raise InputError(f"`{name}` must have shape {want}, got {list(got)}. Reshape it before the call.")


def writable(out: Path, force: bool) -> None:
    """UsageError before any work when what exists would be lost, InputError when there is no folder to write to."""
    if out.exists() and not force:
        raise UsageError(f"{out} exists already. Add --force to replace it, or name another with -o.")
    if not out.absolute().parent.is_dir():
        raise InputError(f"The folder of {out} does not exist. Make it first, or name another file with -o.")
