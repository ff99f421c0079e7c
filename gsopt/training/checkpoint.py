"""Checkpoints: one safetensors file per saved step, written whole or not at all, read back bit for bit."""

from __future__ import annotations

import contextlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsopt.errors import InputError, shortened
from gsopt.events import Report, create, sync_folder

VERSION = 1
KEEP = 2
"""Number of the newest that are kept: the last may have met a full disk or a power cut."""
NAME = re.compile(r"step_(\d+)\.safetensors")


@dataclass(frozen=True)
class Checkpoint:
    """The state a run needs to go on as if it had never stopped."""

    path: Path
    tensors: dict[str, Tensor]
    meta: dict[str, Any]

    def seconds(self, name: str) -> float:
        """A time that the run has spent; InputError for what is no time."""
        value = self.meta.get(name, 0.0)
        if type(value) not in (int, float) or not 0 <= value < 1e12:
            raise InputError(f"The checkpoint {self.path} has {name} {shortened(value)}. Remove it, or start anew.")
        return float(value)


def save_checkpoint(folder: Path, step: int, tensors: dict[str, Tensor], meta: dict[str, Any]) -> Path:
    """Write `step_NNNNNN.safetensors` atomically and remove all but the newest two."""
    path = folder / f"step_{step:06d}.safetensors"
    temporary = folder / f".{path.name}.{os.getpid()}.tmp"
    header = {"gsopt": json.dumps({"version": VERSION, **meta}, allow_nan=False, sort_keys=True)}
    try:
        folder.mkdir(exist_ok=True)
        with create(temporary) as file:
            mode = os.fstat(file.fileno()).st_mode
        save_file({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, temporary, metadata=header)
        temporary.chmod(mode)  # safetensors puts a file of its own there, which nobody else may read
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(folder)  # before an older one goes
    except (OSError, SafetensorError) as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(f"Cannot write the checkpoint {path}: {error}. Free some space, then use --resume.") from error
    for old in saved(folder)[KEEP:]:
        old.unlink(missing_ok=True)
    return path


def saved(folder: Path) -> list[Path]:
    """The checkpoints in a folder, newest step first."""
    found = [
        (int(match[1]), path) for path in folder.glob("step_*.safetensors") if (match := NAME.fullmatch(path.name))
    ]
    return [path for _, path in sorted(found, reverse=True)]


def newest_saved(folder: Path) -> Path | None:
    """The checkpoint of the newest step, None where there is none."""
    return next(iter(saved(folder)), None)


def load_newest(folder: Path, warn: Report) -> Checkpoint | None:
    """The newest checkpoint that can be read, None where there is none; every broken one is reported to `warn`."""
    for path in saved(folder):
        try:
            return read_checkpoint(path)
        except InputError as error:
            warn(str(error))
    return None


def read_checkpoint(path: Path) -> Checkpoint:
    """One checkpoint, or InputError saying why it cannot be used."""
    try:
        with safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {})["gsopt"], parse_constant=_refuse)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        if meta["version"] != VERSION:
            raise ValueError(f"version {meta['version']} instead of {VERSION}")
    except (OSError, SafetensorError, ValueError, LookupError, ArithmeticError, TypeError, RecursionError) as error:
        raise InputError(f"The checkpoint {path} cannot be read ({error}). The one before it is used.") from error
    return Checkpoint(path, tensors, meta)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} in its header")
