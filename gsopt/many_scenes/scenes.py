"""The scenes of `gsopt train-many`: the subfolders of a folder, or the rows of a manifest with their flags."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsopt.data.files import read_json
from gsopt.data.scene import is_posed
from gsopt.data.sfm.reuse import needs_poses
from gsopt.errors import InputError, shortened

OWN_FLAGS = re.compile(
    r"(-m|--run|--model[-_]path|-s|--source[-_]path|--resume|--threads|--checkpoint[-_]every)(=.*)?", re.DOTALL
)
"""Flags of `gsopt train` that this verb sets itself."""
MAX_NAME = 100
MAX_SCENES = 100_000


@dataclass(frozen=True)
class SceneRun:
    """One scene to train on."""

    name: str
    """Folder of the run below RUNS."""
    data: Path
    flags: tuple[str, ...]
    """Flags of `gsopt train`."""


def read_scenes(source: Path, flags: tuple[str, ...] = ()) -> list[SceneRun]:
    """The scenes of a folder in name order, or of a manifest in its order, each with `flags` before its own.

    Raises InputError for a source without scenes, a broken manifest, or two scenes of one name.
    """
    found = list(_of_folder(source, flags) if source.is_dir() else _of_manifest(source, flags))
    if not found:
        raise InputError(f"{source} has no folder with photos or poses. Give the folder whose subfolders are scenes.")
    if len(found) > MAX_SCENES:
        raise InputError(f"{source} has {len(found):,} scenes, more than {MAX_SCENES:,}. Split it.")
    names = [scene.name for scene in found]
    if twice := {name for name in names if names.count(name) > 1} if len(set(names)) < len(names) else set():
        raise InputError(f"{source} names the scene {min(twice)!r} twice. Give each a `name` of its own.")
    return found


def _of_folder(folder: Path, flags: tuple[str, ...]) -> Iterator[SceneRun]:
    for path in sorted(folder.iterdir()):
        if not path.name.startswith(".") and (needs_poses(path) or (path.is_dir() and is_posed(path))):
            yield SceneRun(_name(path.stem if path.is_file() else path.name, path), path.absolute(), _checked(flags))


def _of_manifest(path: Path, flags: tuple[str, ...]) -> Iterator[SceneRun]:
    rows = read_json(path).get("scenes")
    if not isinstance(rows, list):
        raise InputError(f'{path} must hold {{"scenes": [...]}}, got {shortened(rows)}. See docs/howto/cluster.md.')
    for number, row in enumerate(rows):
        where = f"{path}, scene {number}"
        if not isinstance(row, dict) or not isinstance(row.get("data"), str) or not row["data"]:
            raise InputError(f'{where} must be {{"data": FOLDER, ...}}, got {shortened(row)}. Add `data`.')
        own = row.get("flags", [])
        if not isinstance(own, list) or not all(isinstance(word, str) for word in own):
            raise InputError(f"{where}: `flags` must be a list of words, got {shortened(own)}. Split it at its spaces.")
        data = (path.parent / row["data"]).absolute()
        yield SceneRun(_name(row.get("name", data.name), where), data, _checked((*flags, *own)))


def _name(name: Any, where: object) -> str:
    """A name that can be a folder below RUNS."""
    if not isinstance(name, str) or not re.fullmatch(r"[^/\\\0.][^/\\\0]*", name) or len(name) > MAX_NAME:
        raise InputError(f"{where}: `name` must name a new folder, got {shortened(name)}. Use letters and digits.")
    return name


def _checked(flags: tuple[str, ...]) -> tuple[str, ...]:
    if taken := [word for word in flags if OWN_FLAGS.fullmatch(word)]:
        raise InputError(f"`{shortened(taken[0])}` is set by `gsopt train-many` itself. Leave it out of `flags`.")
    return flags
