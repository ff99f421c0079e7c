"""Measures `gsopt merge`: an object that was captured twice, each time from one side, against each run by itself.

    python experiments/merge.py DATASET... [--draw] [-o FILE.json]

Each DATASET is a NeRF-synthetic dataset with 12 input views and views that are held out, such as
`scripts/synth_views.py MESH -o OUT --views 12 --test-views 16 --resolution 200` writes. In the order of their azimuth,
the first 7 views make run A and 8 make run B, the last 5 and the first, sixth and seventh, which both have. The frame
of B is turned, moved and scaled. PSNR of the held-out views, all around the object, of each run by itself, of both
laid over each other, and merged. --draw rewrites the table of docs/howto/merge.md.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gsopt
from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import load_scene
from gsopt.events import to_json, write_atomic
from gsopt.formats.placement import placed
from gsopt.results.clean import input_psnr
from gsopt.results.finished_run import open_run
from gsopt.results.merge import merge, with_degree

HERE = Path(__file__).resolve().parent
RESULT, PAGE = HERE / "results/merge.json", HERE.parent / "docs/howto/merge.md"
TRAIN = "transforms_train.json"
VIEWS_A, VIEWS_B = range(7), (0, 5, 6, 7, 8, 9, 10, 11)
STEPS, SCALE, ANGLE, MOVE = 1000, 1.7, 0.8, (0.3, -0.2, 0.5)
TURN = np.array([[math.cos(ANGLE), -math.sin(ANGLE), 0], [0, 0, -1], [math.sin(ANGLE), math.cos(ANGLE), 0]])
"""Run B's frame from that of the dataset: a quarter of a turn about x after ANGLE about z."""


def part(dataset: Path, target: Path, numbers: range | tuple[int, ...], moved: bool) -> Path:
    """Some of the input views as a dataset of their own, without held-out views."""
    document = json.loads((dataset / TRAIN).read_text(encoding="utf-8"))
    poses = [np.array(frame["transform_matrix"]) for frame in document["frames"]]
    order = sorted(range(len(poses)), key=lambda i: math.atan2(poses[i][1, 3], poses[i][0, 3]))
    document["frames"] = [document["frames"][order[i]] for i in numbers]
    if moved:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = SCALE * TURN @ pose[:3, 3] + MOVE
            pose[:3, :3] = TURN @ pose[:3, :3]
            frame["transform_matrix"] = pose.tolist()
    for frame in document["frames"]:
        for image in dataset.glob(f"{frame['file_path']}*"):
            (target / image.relative_to(dataset)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(image, target / image.relative_to(dataset))
    (target / TRAIN).write_text(json.dumps(document), encoding="utf-8")
    return target


def measured(dataset: Path, folder: Path) -> dict[str, Any]:
    """The record of an object."""
    views = load_scene(gsopt.DataConfig(path=str(dataset))).test
    runs = []
    for name, numbers in (("a", VIEWS_A), ("b", VIEWS_B)):
        data = part(dataset, folder / f"data-{name}", numbers, name == "b")
        gsopt.reconstruct(str(data), folder / name, iterations=STEPS, threads=1)
        runs.append(open_run(folder / name, threads=1))
    turn = torch.from_numpy(TURN.T.copy())
    back = placed(runs[1].gaussians, 1 / SCALE, turn, -turn @ torch.tensor(MOVE, dtype=torch.float64) / SCALE)
    degree = max(runs[0].gaussians.sh_degree, back.sh_degree)
    over = with_degree(runs[0].gaussians, degree).append(with_degree(back, degree))
    merged = merge(*runs)
    arms = {"A": runs[0].gaussians, "B": back, "both": over, "merged": merged.gaussians}
    psnr = {arm: round(input_psnr(runs[0], splats, views), 2) for arm, splats in arms.items()}
    return {"object": dataset.name, "photos in common": merged.alignment.photos, "psnr": psnr, "splats": merged.kept}


def drawn(objects: list[dict[str, Any]]) -> str:
    """A row for each object."""
    head = ["object", "RUN_A, dB", "RUN_B, dB", "both as they are, dB", "merged, dB"]
    return table(head, [[found["object"], *(f"{value:.2f}" for value in found["psnr"].values())] for found in objects])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args()
    torch.set_num_threads(1)
    objects = []
    for dataset in flags.datasets:
        with tempfile.TemporaryDirectory() as folder:
            objects.append(measured(dataset, Path(folder)))
        print(objects[-1], flush=True)
        write_atomic(flags.o, to_json({"objects": objects, "steps": STEPS, "machine": machine()}))
    if flags.draw:
        replace_block(PAGE, "merge", drawn(objects))


if __name__ == "__main__":
    main()
