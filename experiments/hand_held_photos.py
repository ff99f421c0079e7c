"""Poses from a few of the photos of a hand-held camera, against those from all of them.

    python experiments/hand_held_photos.py FOLDERS... --arm ARM [--counts 8 6 4] [--work DIR]

Each folder holds 9 or more photos of one thing or place. Measured with public ones that are not part of gsopt: `kermit`
and `et` of Bundler (github.com/snavely/bundler_sfm, examples), `buddha` (github.com/alicevision/dataset_buddha, CC BY
4.0), `monstree` (github.com/alicevision/dataset_monstree), `sceaux` (github.com/openMVG/ImageDataset_SceauxCastle),
`kitchen`, `statue` and `apple` (github.com/facebookresearch/vggsfm, examples, `apple` in its history), and `llff_fern`
and `llff_flower` (github.com/chenxiex/vggt, examples).
All photos are posed once and kept in DIR; then so many of them, evenly chosen by name, are given alone to `gsopt sfm`.
What it finds is aligned with the poses made of all photos by the best similarity. ARM names the rows in
experiments/results/hand_held_photos.json; rows that are there are not repeated.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from gsopt.benchmark.machine import machine
from gsopt.data.scene import read_dataset
from gsopt.data.sfm.trajectory import compare
from gsopt.events import to_json, write_atomic

RESULTS = Path(__file__).parent / "results" / "hand_held_photos.json"
KINDS = {".jpg", ".jpeg", ".png"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--arm", required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[8, 6, 4])
    parser.add_argument("--work", type=Path, default=Path("runs/hand-held"), help="folder for the scenes of all photos")
    args = parser.parse_args()
    for folder in args.folders:
        photos = sorted(path for path in folder.iterdir() if path.suffix.lower() in KINDS)
        of_all = args.work / folder.name
        if not of_all.exists():
            posed(folder, of_all).check_returncode()
        for count in args.counts:
            name = f"{args.arm} {folder.name}-{count}"
            if name not in read():
                row = measured([photos[at] for at in chosen(len(photos), count)], of_all)
                print(name, json.dumps(row), flush=True)
                write({**read(), name: {"of": len(photos), **row}})


def chosen(total: int, count: int) -> list[int]:
    """Evenly spread rows, the first and the last one among them."""
    return [round(at * (total - 1) / (count - 1)) for at in range(count)]


def posed(photos: Path, scene: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gsopt", "sfm", str(photos), "-o", str(scene)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def measured(photos: list[Path], of_all: Path) -> dict[str, Any]:
    """One call of `gsopt sfm` on a folder that holds nothing but these photos."""
    with tempfile.TemporaryDirectory() as temporary:
        given, scene = Path(temporary, "photos"), Path(temporary, "scene")
        given.mkdir()
        for path in photos:
            shutil.copy2(path, given)
        began = time.perf_counter()
        ended = posed(given, scene)
        row = {"photos": len(photos), "seconds": round(time.perf_counter() - began, 1)}
        if ended.returncode != 0:
            return {**row, "posed": 0, "report": [line for line in ended.stderr.splitlines() if line.strip()][:2]}
        found, truth = (
            {Path(frame.name).stem: frame for frame in read_dataset(path).frames} for path in (scene, of_all)
        )
        record = json.loads((scene / "sfm.json").read_text())
    names = sorted(found.keys() & truth.keys())
    error = compare(*(np.stack([poses[name].viewmat.numpy() for name in names]) for poses in (found, truth)))
    return {
        **row,
        "posed": len(found),
        "mapper": record["mapper"],
        "points": record["points"],
        **{key: value for key, value in error.summary().items() if not key.endswith("median")},
    }


def read() -> dict[str, Any]:
    return dict(json.loads(RESULTS.read_text())["rows"]) if RESULTS.is_file() else {}


def write(rows: dict[str, Any]) -> None:
    write_atomic(RESULTS, to_json({"command": __doc__.split("\n\n")[1].strip(), "machine": machine(), "rows": rows}))


if __name__ == "__main__":
    main()
