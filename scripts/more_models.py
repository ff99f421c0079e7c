"""Further models of Debian's sweethome3d-furniture for training a prior, as a manifest of `synth_views.py`.

    python scripts/more_models.py LIBRARIES MESHES SPLITS [--most 180] > more.json

LIBRARIES holds the package's .sh3f archives, each unpacked into a folder of its name. MESHES/MANIFEST.json and SPLITS
say which models are taken already: none of them is named, and nothing that may be a `val` or `test` object under
another name: the same file name but for digits, the same display name, the same numbers of vertices and faces. Models
without a texture teach little and are left out, as are doors, windows, and files that are heavy to render.
"""

from __future__ import annotations

import argparse
import json
import random
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

LICENSES = {
    "BlendSwap-CC-0": "CC0-1.0",
    "BlendSwap-CC-BY": "CC-BY-3.0",
    "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US",
    "Scopia": "CC-BY-3.0",
}
LARGEST_FILE = 4_000_000
FACES = range(150, 40_001)
OF_ONE_NAME = 3
COMMON_NAMES = {"chair", "cup", "vase"}
"""Display names of held-out objects that are shared by many different models."""

Row = dict[str, str]


def models(libraries: Path) -> Iterator[Row]:
    """Every model of every library, as its catalog has it."""
    for library, license_name in LICENSES.items():
        text = (libraries / library / "PluginFurnitureCatalog.properties").read_text("latin-1")
        catalog: dict[int, Row] = {}
        for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.M):
            catalog.setdefault(int(number), {})[key] = value.strip()
        for entry in catalog.values():
            mesh = libraries / library / entry["model"].lstrip("/")
            yield {
                "id": mesh.stem,
                "mesh": str(mesh.resolve()),
                "name": entry["name"] if "#" not in entry["name"] else mesh.stem,
                "category": entry.get("category", ""),
                "license": license_name,
                "creator": entry.get("creator", ""),
                "fixed": entry.get("doorOrWindow", "false"),
            }


def shape(mesh: Path) -> tuple[int, int]:
    """Numbers of vertices and faces of an OBJ."""
    text = mesh.read_text("latin-1")
    return len(re.findall(r"^v ", text, re.M)), len(re.findall(r"^f ", text, re.M))


def stem(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower())


def usable(row: Row) -> bool:
    """True if it is an object with a texture that renders quickly."""
    mesh = Path(row["mesh"])
    if mesh.suffix != ".obj" or not mesh.is_file() or mesh.stat().st_size > LARGEST_FILE or row["fixed"] == "true":
        return False
    if re.search("door|window", row["name"].lower()) or shape(mesh)[1] not in FACES:
        return False
    return any("map_Kd" in material.read_text("latin-1") for material in mesh.parent.glob("*.mtl"))


def choose(rows: list[Row], meshes: Path, splits: dict[str, list[str]], most: int) -> list[Row]:
    """At most `most`, of one display name no more than OF_ONE_NAME, drawn with seed 0 and sorted."""
    known = {row["id"]: row for row in json.loads((meshes / "MANIFEST.json").read_text())}
    taken = {name.split("/")[-1] for part in ("train", "val", "test", "other") for name in splits[part]}
    held_out = [known[name] for part in ("val", "test") for name in splits[part] if name in known]
    stems = {stem(row["id"].split("/")[-1]) for row in held_out}
    names = {row["name"].lower() for row in held_out} - COMMON_NAMES
    shapes = {shape(meshes / row["obj"]) for row in held_out}
    free = [row for row in rows if row["id"] not in taken and stem(row["id"]) not in stems]
    free = [row for row in free if row["name"].lower() not in names and usable(row)]
    free = [row for row in free if shape(Path(row["mesh"])) not in shapes]
    random.Random(0).shuffle(free)
    met: Counter[str] = Counter()
    chosen: dict[str, Row] = {}
    for row in free:
        met[row["name"].lower()] += 1
        if met[row["name"].lower()] <= OF_ONE_NAME:
            chosen.setdefault(row["id"], row)
    return sorted(list(chosen.values())[:most], key=lambda row: row["id"])


def main() -> None:
    parser = argparse.ArgumentParser(description="See the top of this file.")
    parser.add_argument("libraries", type=Path)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("splits", type=Path)
    parser.add_argument("--most", type=int, default=180)
    options = parser.parse_args()
    splits = json.loads(options.splits.read_text())
    rows = choose(list(models(options.libraries)), options.meshes, splits, options.most)
    print(json.dumps([{key: value for key, value in row.items() if key != "fixed"} for row in rows], indent=1))


if __name__ == "__main__":
    main()
