"""Shapes of the JSON that benchmarks write: checked before a byte reaches the disk.

A schema is a type (float takes whole numbers too), a tuple of alternatives, `[schema]` for a list, a dictionary of
keys to schemas, or `{str: schema}` for a dictionary whose keys are data.
"""

from __future__ import annotations

import math
from typing import Any

from gsopt.errors import InputError, shortened

Schema = Any
SPREAD = {"median": float, "iqr": float}
"""Milliseconds of repeated measurements; iqr is the distance between the quartiles."""
MACHINE = {
    "cpu": str,
    "cores": int,
    "system": str,
    "python": str,
    "torch": str,
    "gsopt": str,
    "commit": (str, None),
    "load": (float, None),
}
CALIBRATION = {str: {"fma_per_second": float, "exp_per_second": float}}
"""Lanes per second of one core, by instruction set."""
STAGES = {str: {"cpu_ms": SPREAD, "wall_ms": SPREAD}}
CASE = {
    "case": str,
    "threads": int,
    "isa": str,
    "width": int,
    "height": int,
    "gaussians": int,
    "repetitions": int,
    "cpu_ms": SPREAD,
    "wall_ms": SPREAD,
    "stages": STAGES,
    "intersections": int,
    "entries": int,
    "useful_pairs": int,
    "lane_use": float,
    "pairs_per_second": {"forward": float, "backward": float},
    "share_of_bound": {"forward": float, "backward": float},
    "render": {"cpu_ms": SPREAD, "wall_ms": SPREAD, "frames_per_second": float},
}
POINT = {"size": int, "cpu_ms": SPREAD, "memory_mb": (float, None)}
GROWTH = {"what": str, "fixed": str, "points": [POINT], "exponent": float, "from_size": int}
ACCURACY = {"backend": str, "ms": SPREAD, "image_max_error": float, "gradient_error": float}
KERNELS = {
    "version": int,
    "command": str,
    "machine": MACHINE,
    "calibration": CALIBRATION,
    "cases": [CASE],
    "growth": [GROWTH],
    "accuracy": {"scene": str, "rows": [ACCURACY]},
}
QUALITY = {
    "step": int,
    "cpu_seconds": float,
    "wall_seconds": float,
    "gaussians": int,
    "psnr": float,
    "ssim": float,
    "lpips_alex": (float, None),
}
"""Held-out quality at one step of a run, and the time that its steps took until then."""
RUN = {
    "scene": str,
    "kind": str,
    "preset": str,
    "iterations": int,
    "max_gaussians": (int, None),
    "points": [QUALITY],
}
SCENES = {"version": int, "command": str, "machine": MACHINE, "runs": [RUN]}


def require(value: Any, schema: Schema, where: str = "result") -> None:
    """Raise InputError naming the first place where `value` departs from `schema`."""
    if isinstance(schema, list):
        _require_type(value, list, where)
        for index, item in enumerate(value):
            require(item, schema[0], f"{where}[{index}]")
    elif isinstance(schema, dict):
        _require_type(value, dict, where)
        by_data = list(schema) == [str]
        if not by_data and set(value) != set(schema):
            raise _mismatch(where, f"the keys {', '.join(sorted(schema))}", sorted(value))
        for key, item in value.items():
            require(item, schema[str if by_data else key], f"{where}.{key}")
    else:
        options = schema if isinstance(schema, tuple) else (schema,)
        if not any(_fits(value, option) for option in options):
            raise _mismatch(where, " or ".join(_name(option) for option in options), value)


def _fits(value: Any, kind: Any) -> bool:
    if kind is None:
        return value is None
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, kind) and not (kind is int and isinstance(value, bool))


def _require_type(value: Any, kind: type, where: str) -> None:
    if not isinstance(value, kind):
        raise _mismatch(where, kind.__name__, value)


def _name(kind: Any) -> str:
    return "null" if kind is None else kind.__name__


def _mismatch(where: str, want: str, got: Any) -> InputError:
    return InputError(
        f"`{where}` must be {want}, got {shortened(got)}. Correct the file, or write it again with `gsopt bench`."
    )
