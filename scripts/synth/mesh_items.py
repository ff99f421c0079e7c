"""The meshes a run renders and what is known about them: files, folders, ShapeNet, manifests."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsopt.errors import InputError
from synth.categories import SHAPENET
from synth.meshfile import mesh_files

MAX_LIST_BYTES = 1 << 30
SHAPENET_MESHES = ("models/model_normalized.obj", "model.obj")
"""Path of the model in its folder: ShapeNetCore.v2, v1."""


@dataclass(frozen=True)
class Item:
    """One object to render."""

    id: str
    """Unique in a run; also its folder below the output, so parts are separated by /."""
    mesh: Path
    name: str | None = None
    category: str | None = None
    license: str | None = None
    creator: str | None = None
    caption: str | None = None
    front: tuple[float, float] | None = None
    """Direction of its front, as x and y of the world, or None when unknown."""

    @property
    def noun(self) -> str:
        """Noun for captions: the name, else the category."""
        return self.name or self.category or "object"

    def known(self) -> dict[str, Any]:
        """All but the path, which differs from machine to machine."""
        return {k: v for k, v in dataclasses.asdict(self).items() if k != "mesh"}


def of_paths(paths: Iterable[Path]) -> Iterator[Item]:
    """Files as they are named; folders with all meshes below them, named by their path in the folder."""
    for path in paths:
        if path.is_dir():
            found = list(mesh_files(path))
            if not found:
                raise InputError(f"The folder {path} holds no mesh. Give one that does, or name files.")
            yield from (Item(safe_id(i), mesh) for i, mesh in zip(ids_in(path, found), found, strict=True))
        else:
            yield Item(safe_id(path.stem), path)


def ids_in(folder: Path, meshes: list[Path]) -> list[str]:
    """Paths in `folder` without their suffix; with it where another mesh or a folder of meshes has the bare name."""
    named = [mesh.relative_to(folder) for mesh in meshes]
    bare = [name.with_suffix("").as_posix() for name in named]
    taken = Counter(name.casefold() for name in bare)
    taken.update({parent.as_posix().casefold() for name in named for parent in name.parents})
    return [b if taken[b.casefold()] == 1 else name.as_posix() for b, name in zip(bare, named, strict=True)]


def of_shapenet(root: Path, synsets: tuple[str, ...]) -> Iterator[Item]:
    """Models of ShapeNetCore v1 or v2: ROOT/synset/model. They face -z with y up, which is +y after import."""
    names = category_names(root)
    try:
        present = sorted(p.name for p in root.iterdir() if re.fullmatch(r"\d{8}", p.name))
        absent = sorted(set(synsets) - set(present))
        if not present or absent:
            what = f"no synset {', '.join(absent)}" if absent else "no synset folder such as 03001627"
            raise InputError(f"{root} has {what}. Give ShapeNetCore's folder; it has {', '.join(present) or 'none'}.")
        for synset in synsets or present:
            for model in sorted(p for p in (root / synset).iterdir() if p.is_dir()):
                meshes = [model / name for name in SHAPENET_MESHES]
                mesh = next((m for m in meshes if m.is_file()), meshes[0])
                yield Item(
                    f"{synset}/{safe_id(model.name)}",
                    mesh,
                    category=names.get(synset, synset),
                    license="ShapeNet terms of use (non-commercial research and education)",
                    front=(0.0, 1.0),
                )
    except OSError as error:
        raise InputError(f"Cannot list ShapeNet in {root}: {error.strerror}. Check path and permissions.") from None


def category_names(root: Path) -> dict[str, str]:
    """Category of each synset: from taxonomy.json where there is one, over the bundled table."""
    taxonomy = root / "taxonomy.json"
    if not taxonomy.is_file():
        return SHAPENET
    try:
        entries = json.loads(taxonomy.read_text(encoding="utf-8"))
        return SHAPENET | {entry["synsetId"]: entry["name"].split(",")[0] for entry in entries}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{taxonomy} is not ShapeNet's: {error}. Restore it, or remove it.") from None


def of_manifest(manifest: Path) -> Iterator[Item]:
    """One object a row of a .json, .jsonl or .csv file: `mesh` (or obj, path, file), seen from the manifest's folder,
    and, where known, id, name, category, license, creator, caption."""
    for number, row in enumerate(manifest_rows(manifest)):
        known = {k: str(v) for k, v in row.items() if v not in (None, "")} if isinstance(row, dict) else {}
        mesh = next((known[key] for key in ("mesh", "obj", "path", "file") if key in known), None)
        if mesh is None:
            raise InputError(f"Row {number} of {manifest} names no mesh. Give each a path under the key `mesh`.")
        texts = {key: known.get(key) for key in ("name", "category", "license", "creator", "caption")}
        yield Item(safe_id(known.get("id") or Path(mesh).stem), manifest.parent / mesh.replace("\\", "/"), **texts)


def manifest_rows(manifest: Path) -> list[Any]:
    try:
        if manifest.stat().st_size > MAX_LIST_BYTES:
            raise ValueError(f"it is larger than {MAX_LIST_BYTES:,} bytes")
        text = manifest.read_text(encoding="utf-8-sig")
        if manifest.suffix.lower() == ".csv":
            return list(csv.DictReader(text.splitlines()))
        if manifest.suffix.lower() == ".jsonl":
            return [json.loads(line) for line in text.splitlines() if line.strip()]
        document = json.loads(text)
        rows = document["objects"] if isinstance(document, dict) else document
        if not isinstance(rows, list):
            raise ValueError("it holds no list")
        return rows
    except (OSError, ValueError, KeyError, RecursionError, csv.Error) as error:
        remedy = "Give a list of objects, each with `mesh`."
        raise InputError(f"Cannot read the manifest {manifest}: {error}. {remedy}") from None


def safe_id(text: str) -> str:
    """`text` as a relative path that any file system takes: letters of every script stay, as do spaces."""
    clean = re.sub(r'[\x00-\x1f<>:"|?*]', "_", text).replace("\\", "/")
    parts = [part.strip().lstrip(".")[:150] for part in clean.split("/")]
    return "/".join(part for part in parts if part) or "object"


def unique(items: Iterable[Item]) -> list[Item]:
    """The items; InputError when two would be written to one place, or one inside another."""
    found: dict[str, Item] = {}
    for item in items:
        key = item.id.casefold()
        if key in found:
            raise InputError(
                f"{item.mesh} and {found[key].mesh} would both be called {item.id!r}. Name them in a `--manifest` "
                "with an `id` each, or give the folder above both."
            )
        found[key] = item
    for key, item in found.items():
        for at in (i for i, letter in enumerate(key) if letter == "/"):
            if key[:at] in found:
                raise InputError(f"{item.id!r} would lie inside {found[key[:at]].id!r}. Give ids in a `--manifest`.")
    if not found:
        raise InputError("There is no mesh to render. Give meshes, `--shapenet ROOT` or `--manifest FILE`.")
    return list(found.values())
