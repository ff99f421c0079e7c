"""Whole scenes from eight photos without masks: things on a table in a room, seen from all around or over 150 degrees.

    python experiments/table_photos.py MESHES SCENES --render            # needs bpy; 15 s a photo
    python experiments/table_splats.py SCENES OUT --arm NAME [--only vase2 ...] [--train="--seed 1"]

Of the 12 photos of each scene, at half their size and with their exact cameras, every third one is held out. ARM names
the rows in experiments/results/table_splats.json; rows that are there are not repeated. The runs stay in OUT.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from table_photos import LENS, SCENES, SENSOR, SIZE

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic

RESULTS = Path(__file__).parent / "results" / "table_splats.json"
HALF = SIZE[0] // 2, SIZE[1] // 2
MEANS = ("psnr", "cc_psnr", "ssim", "lpips_alex")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--arm", required=True)
    parser.add_argument("--only", nargs="*", default=list(SCENES), choices=SCENES)
    parser.add_argument("--train", default="", help="more words for `gsopt train`")
    args = parser.parse_args()
    for name in args.only:
        key, rows = f"{args.arm} {name}", read()
        if key not in rows:
            data = dataset(args.scenes / name, args.out / "data" / name)
            row = trained(data, args.out / key.replace(" ", "_"), shlex.split(args.train))
            print(key, json.dumps(row), flush=True)
            write_atomic(RESULTS, to_json({"machine": machine(), "rows": {**read(), key: row}}))


def read() -> dict[str, Any]:
    return dict(json.loads(RESULTS.read_text())["rows"]) if RESULTS.is_file() else {}


def dataset(scene: Path, data: Path) -> Path:
    """The photos with their exact cameras, as transforms.json."""
    (data / "images").mkdir(parents=True, exist_ok=True)
    frames: list[dict[str, Any]] = []
    for name, cam_from_world in sorted(json.loads((scene / "cameras.json").read_text()).items()):
        file = f"images/{name}.png"
        with Image.open(scene / f"{name}.png", formats=("PNG",)) as image:
            image.convert("RGB").resize(HALF, Image.Resampling.LANCZOS).save(data / file)
        pose = np.linalg.inv(np.array(cam_from_world)) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": file, "transform_matrix": pose.tolist()})
    files = [frame["file_path"] for frame in frames]
    focal = HALF[0] * LENS / SENSOR
    lens = {"fl_x": focal, "fl_y": focal, "cx": HALF[0] / 2, "cy": HALF[1] / 2, "w": HALF[0], "h": HALF[1]}
    held_out = files[1::3]
    split = {"train_filenames": [file for file in files if file not in held_out], "test_filenames": held_out}
    write_atomic(data / "transforms.json", to_json({**lens, **split, "val_filenames": held_out, "frames": frames}))
    return data


def trained(data: Path, out: Path, words: list[str]) -> dict[str, Any]:
    """Means over the held-out photos."""
    command = [sys.executable, "-m", "gsopt", "train", str(data), "-m", str(out), "--eval", "--threads", "1", *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    metrics = json.loads((out / "metrics.json").read_text())
    return {mean: round(metrics["mean"][mean], 4) for mean in MEANS}


if __name__ == "__main__":
    main()
