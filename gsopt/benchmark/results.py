"""kernels.json: read, merged with what was measured now, checked, written whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsopt.benchmark import schema
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic

VERSION = 1
EMPTY: dict[str, Any] = {"cases": [], "growth": [], "accuracy": {"scene": "", "rows": []}}


def read(path: Path) -> dict[str, Any]:
    """An earlier result; InputError when the file is something else."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON ({error}). Remove it, or name another file.") from error
    schema.require(document, schema.KERNELS, path.name)
    found: dict[str, Any] = document
    return found


def update(path: Path, measured: dict[str, Any]) -> None:
    """Write `measured` (command, machine, calibration and any of cases, growth, accuracy); records of other cases and
    parts that were not measured now are kept. Raises InputError before anything is written when the shape is wrong."""
    old = read(path) if path.exists() else EMPTY
    document = {"version": VERSION, **{part: old[part] for part in EMPTY}, **measured}
    if "cases" in measured:
        document["cases"] = merged(old["cases"], measured["cases"])
    schema.require(document, schema.KERNELS)
    write_atomic(path, to_json({key: document[key] for key in schema.KERNELS}))


def merged(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One record per case, number of threads and instruction set: the newer one, in order of the work in it."""
    records = {(record["case"], record["threads"], record["isa"]): record for record in [*old, *new]}
    return sorted(records.values(), key=lambda r: (r["width"] * r["height"], r["gaussians"], r["threads"], r["isa"]))
