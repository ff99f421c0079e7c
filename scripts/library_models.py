"""The meshes of the shape library that ships, as a list of `gsopt finetune --library`.

    python scripts/library_models.py LIBRARIES MESHES SPLITS > library.json
    gsopt finetune --library library.json -o gsopt/weights/shape_library.safetensors

LIBRARIES holds the .sh3f archives of Debian's sweethome3d-furniture, each unpacked into a folder of its name; MESHES
has a MANIFEST.json of the models of the `train` list of SPLITS. The list holds these, as far as their licenses let
them ship, and every further model of the archives but doors, windows, and what may be a `val` or `test` object under
another name: the same id, file name but for digits, display name, numbers of vertices and faces, or voxels.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path

from more_models import COMMON_NAMES, LICENSES, Row, models, shape, stem

LARGEST_FILE = 6_000_000
LEAST_FACES = 60
OF_ONE_NAME = 20
NAMES = {"Hot dog": "Hotdog", "Trunck": "Trunk", "Hashtray": "Ashtray", "Cup cake": "Cupcake", "Chaussette": "Sock"}
"""Display names that would be found by another thing's word, and misspelled ones."""
TWINS = {"com_bath"}
"""Models whose voxels are those of a held-out object (IoU above 0.97), though their counts differ."""
LYING = "1 0 0 0 0 1 0 -1 0"
"""The catalog's rotation of a model whose file has z upward."""


def rotations(libraries: Path) -> dict[str, str]:
    """The catalogs' rotations by the model's id."""
    found = {}
    for library in LICENSES:
        text = (libraries / library / "PluginFurnitureCatalog.properties").read_text("latin-1")
        files = dict(re.findall(r"^model#(\d+)=(.*)$", text, re.M))
        for number, rotation in re.findall(r"^modelRotation#(\d+)=(.*)$", text, re.M):
            found[Path(files[number].strip()).stem] = rotation.strip()
    return found


def train(meshes: Path, splits: dict[str, list[str]]) -> list[Row]:
    """The models of the `train` list."""
    known = {row["id"]: row for row in json.loads((meshes / "MANIFEST.json").read_text())}
    rows = [known[name] for name in splits["train"] if known[name]["license"] in LICENSES.values()]
    keys = ("name", "category", "license", "creator")
    return [
        {"id": row["id"].split("/")[-1], "mesh": str((meshes / row["obj"]).resolve()), **{k: row[k] for k in keys}}
        for row in rows
    ]


def further(libraries: Path, meshes: Path, splits: dict[str, list[str]]) -> list[Row]:
    """The other models of the archives that cannot be held-out objects, each shape once."""
    known = {row["id"]: row for row in json.loads((meshes / "MANIFEST.json").read_text())}
    taken = {name.split("/")[-1] for part in ("train", "val", "test", "other") for name in splits[part]}
    held_out = [known[name] for part in ("val", "test") for name in splits[part] if name in known]
    stems = {stem(row["id"].split("/")[-1]) for row in held_out}
    names = {row["name"].lower() for row in held_out} - COMMON_NAMES
    shapes = {shape(meshes / row["obj"]) for row in held_out}
    found: list[Row] = []
    for row in models(libraries):
        mesh = Path(row["mesh"])
        if mesh.suffix != ".obj" or not mesh.is_file() or mesh.stat().st_size > LARGEST_FILE:
            continue
        if (
            row["id"] in taken | TWINS
            or stem(row["id"]) in stems
            or row["name"].lower() in names
            or row["fixed"] == "true"
        ):
            continue
        counts = shape(mesh)
        if counts in shapes or counts[1] < LEAST_FACES or re.search("door|window", row["name"].lower()):
            continue
        if sum(other["name"] == row["name"] for other in found) < OF_ONE_NAME:
            shapes.add(counts)
            taken.add(row["id"])
            found.append({key: value for key, value in row.items() if key != "fixed"})
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="See the top of this file.")
    parser.add_argument("libraries", type=Path)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("splits", type=Path)
    options = parser.parse_args()
    splits, turned = json.loads(options.splits.read_text()), rotations(options.libraries)
    rows = train(options.meshes, splits) + further(options.libraries, options.meshes, splits)
    for row in rows:
        row["name"] = NAMES.get(row["name"], row["name"])
        if turned.get(row["id"]) == LYING:
            row["up"] = "z"
    print(json.dumps(sorted(rows, key=lambda row: row["id"]), indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
