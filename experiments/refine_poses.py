"""Measures the benefit of `--refine-poses`: one scene with true poses, disturbed poses, and refined poses.

python experiments/refine_poses.py --data DATA/nerf_synthetic_lego_400 --work WORK writes
experiments/results/refine_poses.json. Every input camera is rotated by --degrees about a random axis through itself and
moved by that angle (in radians) times its distance from the origin; held-out views keep the true poses. One seed.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results" / "refine_poses.json"
SEED = 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a NeRF-synthetic folder")
    parser.add_argument("--work", type=Path, required=True, help="folder for datasets and runs; reused")
    parser.add_argument("--degrees", type=float, default=0.5)
    parser.add_argument("--train", default="-r 2 --iterations 7000 --threads 1", help="flags of `gsopt train`")
    options = parser.parse_args()
    disturbed = disturb(options.data, options.work / f"disturbed-{options.degrees:g}", options.degrees)
    cases: tuple[tuple[str, Path, list[str]], ...] = (
        ("true poses", options.data, []),
        ("true poses, refined", options.data, ["--refine-poses"]),
        ("disturbed poses", disturbed, []),
        ("disturbed poses, refined", disturbed, ["--refine-poses"]),
    )
    rows = {}
    for name, data, flags in cases:
        run = options.work / name.replace(", ", "-").replace(" ", "-")
        rows[name] = trained(data, run, [*options.train.split(), *flags]) | pose_error(data, run, options.data)
    document = {
        "command": "python experiments/refine_poses.py --data DATA --work WORK",
        "data": options.data.name,
        "degrees": options.degrees,
        "training": options.train,
        "cases": rows,
    }
    RESULTS.write_text(json.dumps(document, indent=1) + "\n")


def disturb(data: Path, target: Path, degrees: float) -> Path:
    """A copy of the dataset (images linked) with disturbed input cameras."""
    if target.exists():
        return target
    target.mkdir(parents=True)
    for path in data.iterdir():
        if path.name != "transforms_train.json":
            (target / path.name).symlink_to(path.absolute())
    document = json.loads((data / "transforms_train.json").read_text())
    rng = np.random.default_rng(SEED)
    for frame in document["frames"]:
        matrix = np.array(frame["transform_matrix"])  # world_from_cam
        axis, direction = rng.normal(size=(2, 3))
        matrix[:3, :3] = matrix[:3, :3] @ rotation(axis, math.radians(degrees))
        way = np.linalg.norm(matrix[:3, 3]) * math.radians(degrees)
        matrix[:3, 3] += way * direction / np.linalg.norm(direction)
        frame["transform_matrix"] = matrix.tolist()
    (target / "transforms_train.json").write_text(json.dumps(document))
    return target


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by `angle` about `axis` (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def trained(data: Path, run: Path, flags: list[str]) -> dict[str, Any]:
    if not (run / "metrics.json").is_file():
        subprocess.run([sys.executable, "-m", "gsopt", "train", str(data), "-m", str(run), *flags], check=True)
    metrics = json.loads((run / "metrics.json").read_text())
    figures = {name: round(metrics["mean"][name], 4) for name in ("psnr", "ssim", "lpips_alex")}
    return {**figures, "held_out": len(metrics["per_view"]), "train_cpu_seconds": metrics.get("train_cpu_seconds")}


def pose_error(data: Path, run: Path, truth: Path) -> dict[str, Any]:
    """Error of the run's final input cameras after the best similarity."""
    from gsopt.data.scene import read_dataset
    from gsopt.data.sfm.trajectory import compare

    true = {frame.name: frame.viewmat.numpy() for frame in read_dataset(truth).frames}
    if (run / "poses.json").is_file():
        views = json.loads((run / "poses.json").read_text())["views"]
        found = {view["name"]: np.array(view["cam_from_world"]) for view in views}
    else:
        found = {frame.name: frame.viewmat.numpy() for frame in read_dataset(data).frames}
    names = sorted(found)
    error = compare(np.stack([found[name] for name in names]), np.stack([true[name] for name in names])).summary()
    return {name: error[name] for name in ("rotation_degrees_rms", "position_rms")}


if __name__ == "__main__":
    main()
