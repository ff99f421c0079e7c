"""Checks at the border: each raises an error that says what, got, do."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from gsopt.errors import InputError, UsageError

if TYPE_CHECKING:
    from torch import Tensor


def at_least(name: str, value: float, minimum: float, remedy: str) -> None:
    """Raise UsageError unless `value` is a number >= `minimum`; `remedy` says what to do instead."""
    if not value >= minimum:
        raise UsageError(f"`{name}` must be at least {minimum}, got {value}. {remedy}")


def within(name: str, value: float, low: float, high: float, remedy: str) -> None:
    """Raise UsageError unless `low` <= `value` <= `high` (NaN is refused)."""
    if not (low <= value <= high) or math.isnan(value):
        raise UsageError(f"`{name}` must lie in [{low}, {high}], got {value}. {remedy}")


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise UsageError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise UsageError(f"`{name}` must be one of {', '.join(allowed)}; got {value!r}. Pick one of these.")


def finite(name: str, tensor: Tensor, largest: float = math.inf) -> None:
    """Raise InputError naming the first element of `tensor` that is NaN, infinite or beyond `largest` in magnitude."""
    import torch

    good = torch.isfinite(tensor) & (tensor.abs() <= largest)
    if bool(good.all()):
        return
    index = tuple(torch.nonzero(~good)[0].tolist())
    got = tensor[index].item()
    limit = "" if math.isinf(largest) else f" and within {largest:.3g}"
    raise InputError(f"`{name}` must be finite{limit}, got {got} at index {list(index)}. Remove or repair that row.")


def shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    """Raise InputError unless the tensor's shape is `expected` (None = any extent)."""
    got = tuple(tensor.shape)
    if len(got) != len(expected) or any(e is not None and e != g for e, g in zip(expected, got, strict=True)):
        want = "[" + ", ".join("?" if e is None else str(e) for e in expected) + "]"
        raise InputError(f"`{name}` must have shape {want}, got {list(got)}. Reshape it before the call.")
