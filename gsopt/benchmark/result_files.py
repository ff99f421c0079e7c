"""Result files of kernels and scenes: read, merged with new measurements, checked, written whole."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsopt.benchmark import schema
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic

VERSION = 1
EMPTY: dict[str, Any] = {"cases": [], "growth": [], "accuracy": {"scene": "", "rows": []}}


def read(path: Path, shape: schema.Schema = schema.KERNELS) -> dict[str, Any]:
    """An earlier result; InputError when the file is something else."""
    found = parsed(path)
    schema.require(found, shape, path.name)
    return found


def parsed(path: Path) -> dict[str, Any]:
    """A JSON object with any content."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON ({error}). Remove it, or name another file.") from error
    schema.require(document, dict, path.name)
    found: dict[str, Any] = document
    return found


def update(path: Path, measured: dict[str, Any]) -> None:
    """Writes `measured` (command, machine, calibration and any of cases, growth, accuracy) and keeps the records of
    other cases and parts. Raises InputError before anything is written when the shape is wrong."""
    old = read(path) if path.exists() else EMPTY
    document = {"version": VERSION, **{part: old[part] for part in EMPTY}, **measured}
    if "cases" in measured:
        document["cases"] = merged(old["cases"], measured["cases"])
    schema.require(document, schema.KERNELS)
    write_atomic(path, to_json({key: document[key] for key in schema.KERNELS}))


def merged(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One record per case, number of threads and instruction set, the newer one, ordered by size."""
    records = {(record["case"], record["threads"], record["isa"]): record for record in [*old, *new]}
    return sorted(records.values(), key=lambda r: (r["width"] * r["height"], r["gaussians"], r["threads"], r["isa"]))


def run_key(record: dict[str, Any]) -> tuple[Any, ...]:
    """Key that is equal for records of the same run of a scene."""
    return record["scene"], record["kind"], record["preset"], record["iterations"], record["max_gaussians"]


def update_runs(path: Path, command: str, machine: dict[str, Any], record: dict[str, Any]) -> None:
    """Adds one run of a scene to a file, in place of an older record of the same run."""
    old = read(path, schema.SCENES)["runs"] if path.exists() else []
    runs = [run for run in old if run_key(run) != run_key(record)] + [record]
    document = {"version": VERSION, "command": command, "machine": machine, "runs": runs}
    schema.require(document, schema.SCENES)
    write_atomic(path, to_json(document))
