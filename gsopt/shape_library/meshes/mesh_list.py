"""The meshes of a library and the words beside them: a folder, ShapeNet's folders, or a list.

A folder: every mesh below it, named by its path. Beside a mesh `NAME.obj` a text file `NAME.txt` may describe it; in
ShapeNet's layout (`SYNSET/MODEL/models/model_normalized.obj`, taxonomy.json) the synset names the category. A file
`library.json` in the folder, or a .json given in its place, is a list of objects with `mesh` and, where known, `id`,
`name`, `category`, `words`, `license`, `creator`, and `up` (y or z) where a file's own axes differ from its kind's.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsopt.errors import InputError
from gsopt.shape_library.entry import MAX_TEXT_LENGTH, Entry
from gsopt.shape_library.library_file import MAX_ENTRIES, printable
from gsopt.shape_library.meshes.mesh_points import SUFFIXES

LIST = "library.json"
MAX_LIST_BYTES = 256 << 20
MAX_CAPTION_BYTES = 4096
SYNSET = re.compile(r"\d{8}")
PLUMBING = frozenset({"models", "model", "model_normalized", "mesh", "meshes", "obj"})
"""Names of folders and files that say nothing about what is in them."""


@dataclass(frozen=True)
class Source:
    """A mesh to read, and its entry."""

    mesh: Path
    entry: Entry
    up: Literal["", "y", "z"] = ""
    """Upward axis of the file; empty for that of its kind."""


def find_meshes(path: Path) -> list[Source]:
    """The sources of a library in the order of their ids. Raises InputError when there is none, or two have one id."""
    listed = path if path.suffix == ".json" else path / LIST
    found = sorted(_listed(listed) if listed.is_file() else _in_folder(path), key=lambda source: source.entry.id)
    if not 0 < len(found) <= MAX_ENTRIES:
        raise InputError(
            f"{path} has {len(found):,} meshes; a library takes 1 to {MAX_ENTRIES:,}. Give a folder with "
            f"{', '.join(SUFFIXES)} files, or a {LIST} that names them."
        )
    ids = [source.entry.id for source in found]
    twice = next((one for one, other in itertools.pairwise(ids) if one == other), None)
    if twice is not None:
        raise InputError(f"{path} has two meshes called {twice!r}. Give each an `id` of its own in {LIST}.")
    return found


def _in_folder(folder: Path) -> Iterator[Source]:
    if not folder.is_dir():
        raise InputError(f"There is no folder of meshes at {folder}. Correct the path, or give a {LIST}.")
    names = _taxonomy(folder)
    for where, below, files in os.walk(folder):
        below.sort()
        for name in sorted(files):
            mesh = Path(where, name)
            if mesh.suffix.lower() in SUFFIXES:
                yield Source(mesh, _named(mesh, folder, names))


def _named(mesh: Path, folder: Path, synsets: dict[str, str]) -> Entry:
    """The entry of a mesh that only its path and a text beside it describe."""
    parts = [part for part in mesh.relative_to(folder).with_suffix("").parts if part.lower() not in PLUMBING]
    kinds = [synsets.get(part, part) for part in parts[:-1]]
    last = parts[-1] if parts else mesh.stem
    speaks = re.search(r"[^\W\d_]{3}", last) and not re.fullmatch(r"[0-9a-f]{16,}", last)
    name = _spoken(last) if speaks else (_spoken(kinds[-1]) if kinds else "")
    caption = _caption(mesh.with_suffix(".txt"))
    identity = mesh.relative_to(folder).with_suffix("").as_posix()
    texts = (identity, name, " ".join(map(_spoken, kinds)), caption)
    identity, name, category, words = (printable(text)[:MAX_TEXT_LENGTH] for text in texts)
    return Entry(identity or mesh.name[:MAX_TEXT_LENGTH], name, category, words)


def _spoken(name: str) -> str:
    """`red_kitchenChair2` as words."""
    return " ".join(re.sub(r"[\W\d_]+", " ", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)).split())


def _caption(file: Path) -> str:
    try:
        with file.open("rb") as opened:
            return opened.read(MAX_CAPTION_BYTES).decode("utf-8", "ignore")
    except OSError:
        return ""


def _taxonomy(folder: Path) -> dict[str, str]:
    """Names of ShapeNet's synsets, where the folder has its taxonomy."""
    file = folder / "taxonomy.json"
    if not file.is_file():
        return {}
    rows = _json(file)
    try:
        return {row["synsetId"]: row["name"].split(",")[0] for row in rows if SYNSET.fullmatch(row["synsetId"])}
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} is not ShapeNet's taxonomy ({error!r}). Restore it, or remove it.") from None


def _listed(file: Path) -> Iterator[Source]:
    rows = _json(file)
    if not isinstance(rows, list):
        raise InputError(f"{file} holds no list. Give a list of objects, each with `mesh`.")
    for number, row in enumerate(rows):
        try:
            mesh = file.parent / row["mesh"]
            texts = {key: printable(str(row.get(key) or ""))[:MAX_TEXT_LENGTH] for key in _entry_keys()}
            texts["id"] = texts["id"] or mesh.stem[:MAX_TEXT_LENGTH]
            up = row.get("up", "")
            if up not in ("", "y", "z"):
                raise ValueError(f"`up` is {up!r:.20}, not y or z")
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise InputError(f"Row {number} of {file} is no object with `mesh`: {error!r:.100}. Correct it.") from None
        yield Source(mesh, Entry(**texts), up)


def _entry_keys() -> list[str]:
    return [field.name for field in dataclasses.fields(Entry)]


def _json(file: Path) -> Any:
    try:
        if file.stat().st_size > MAX_LIST_BYTES:
            raise ValueError(f"larger than {MAX_LIST_BYTES:,} bytes")
        return json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read {file}: {error!s:.200}. Give valid JSON.") from None
