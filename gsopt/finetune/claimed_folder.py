"""The folder of a training: it belongs to the plan that stands in it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsopt.data.files import read_json
from gsopt.errors import InputError
from gsopt.events import TEMPORARY, sweep, to_json, write_atomic


def claim(path: Path, plan: dict[str, Any], kind: str, inputs: str, beside: str = "") -> None:
    """Writes the plan to `path` in a new folder, and removes what a killed training left half written.

    Raises InputError when the folder belongs to another plan, or holds anything but an entry `beside`. The error names
    the `kind` of training and its `inputs`.
    """
    out = path.parent
    if path.exists():
        found = {key: value for key, value in read_json(path).items() if key != "measured"}
        if found != json.loads(to_json(plan)):
            raise InputError(f"{out} belongs to a training with {inputs} or flags. Repeat them or give another -o.")
    elif out.exists() and (not out.is_dir() or any(_is_foreign(entry, beside) for entry in out.iterdir())):
        raise InputError(f"{out} is not empty and holds no training of {kind}. Give another -o.")
    else:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"Cannot make {out}: {error.strerror or error}. Give another -o.") from error
        write_atomic(path, to_json(plan))
    sweep(out, *(entry for entry in out.iterdir() if entry.is_dir() and not entry.is_symlink()))


def _is_foreign(entry: Path, beside: str) -> bool:
    """True for what no training killed at its first write left."""
    return entry.name != beside and not TEMPORARY.fullmatch(entry.name)
