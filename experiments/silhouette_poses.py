"""Are poses better on which the silhouettes agree? Held-out views of one scene, with its poses and with moved ones.

    python experiments/silhouette_poses.py SCENE OUT [--train="-r 4 --threads 1"]

SCENE is a posed scene of photos with alpha: 12 photos of the museum head as `gsopt sfm --features both` posed them from
these photos and masks alone, before silhouettes held poses. All its poses are moved together (gsopt/data/sfm/
silhouettes.py); then every third photo is held out, in three turns, with both poses. A held-out photo's mask takes part
in moving its pose, its colors never do. Rows go to experiments/results/silhouette_poses.json.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.data.scene import load_scene
from gsopt.data.sfm.silhouettes import coherent_poses
from gsopt.events import to_json, write_atomic
from gsopt.geometry.cameras import opengl_from_viewmats

RESULTS = Path(__file__).parent / "results" / "silhouette_poses.json"
TURNS = 3
METRICS = ("psnr", "psnr_object", "ssim", "lpips_alex")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train", default="-r 4 --threads 1", help="more words for `gsopt train`")
    args = parser.parse_args()
    views = load_scene(args.scene).train
    names = [view.name for view in views]
    found = coherent_poses(views)
    assert found is not None
    moved = dict(zip(names, opengl_from_viewmats(found.viewmats).tolist(), strict=True))
    rows = []
    for turn in range(TURNS):
        for poses in ("found", "moved"):
            data = split(
                args.scene, args.out / f"{turn}-{poses}", names[turn::TURNS], moved if poses == "moved" else {}
            )
            rows.append({"turn": turn, "poses": poses, **trained(data, shlex.split(args.train))})
            print(json.dumps(rows[-1]), flush=True)
    misses = {"before": found.before, "after": found.after}
    command = __doc__.split("\n\n")[1].strip()
    write_atomic(RESULTS, to_json({"command": command, "machine": machine(), "misses_px": misses, "rows": rows}))


def split(scene: Path, data: Path, held_out: list[str], moved: dict[str, Any]) -> Path:
    """The scene with other poses where `moved` has them, and some views held out."""
    document = json.loads((scene / "transforms.json").read_text())
    frames = document["frames"]
    for frame in frames:
        frame["transform_matrix"] = moved.get(frame["file_path"], frame["transform_matrix"])
    data.mkdir(parents=True, exist_ok=True)
    if not (data / "images").exists():
        (data / "images").symlink_to((scene / "images").resolve())
        (data / "points.ply").symlink_to((scene / "points.ply").resolve())
    for name, held in (("train", False), ("test", True)):
        chosen = [frame for frame in frames if (frame["file_path"] in held_out) == held]
        write_atomic(data / f"transforms_{name}.json", to_json({**document, "frames": chosen}))
    return data


def trained(data: Path, flags: list[str]) -> dict[str, float]:
    """Held-out figures of one run."""
    run = data / "run"
    if not (run / "metrics.json").is_file():
        command = [sys.executable, "-m", "gsopt", "train", str(data), "-m", str(run), "--lambda_sds", "0", *flags]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    mean = json.loads((run / "metrics.json").read_text())["mean"]
    return {name: round(mean[name], 4) for name in METRICS}


if __name__ == "__main__":
    main()
