"""How much is an object from one, two or three photos worth, before a change to gsopt and after it?

    python experiments/few_photos.py SCENES... --views 1 2 3 --arm ARM [-o FILE.json] [--seeds 3]
    python experiments/few_photos.py --views 2 --compare "5fcb82b" "axes and level mirrors"

SCENES are posed scenes of objects with alpha and held-out views, or folders of them. A seed is a choice of photos: for
one photo an input view between 15 and 45 degrees of elevation, for more of them input views at least 30 degrees apart,
drawn at random. An arm is the name of what is run: `photo alone` leaves all guesses about one photo out, any other
takes the defaults of the gsopt that Python imports; a checkout on PYTHONPATH measures an earlier one. Runs that have a
record in FILE are not made again. --compare prints a table of two arms (held-out PSNR and LPIPS, paired per object,
standard error over objects) from FILE; docs/decisions/ quote it.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic

FLAGS = {"photo alone": ["--sparse.inflate", "off", "--sparse.symmetry", "off"]}
METRICS = ("psnr", "ssim", "lpips_alex")
ELEVATIONS = (15.0, 45.0)
LEAST_ANGLE = 30.0
RESULT = Path(__file__).parent / "results" / "few_photos.json"


def scenes(roots: list[Path]) -> list[Path]:
    """Folders with held-out views."""
    found = [p for root in roots for p in (root, *sorted(root.iterdir()))]
    return [p for p in found if (p / "transforms_test.json").is_file()]


def photos(scene: Path, views: int, seed: int) -> list[int]:
    """Rows of the input views that a seed chooses."""
    frames = json.loads((scene / "transforms_train.json").read_text())["frames"]
    centers = [[frame["transform_matrix"][axis][3] for axis in range(3)] for frame in frames]
    if views == 1:
        low, high = ELEVATIONS
        rows = [
            row for row, (x, y, z) in enumerate(centers) if low <= math.degrees(math.atan2(z, math.hypot(x, y))) <= high
        ]
        return [random.Random(seed).choice(rows)]
    drawn = random.Random(seed)
    while True:
        rows = sorted(drawn.sample(range(len(centers)), views))
        if all(_degrees(centers[a], centers[b]) > LEAST_ANGLE for a in rows for b in rows if a < b):
            return rows


def _degrees(a: list[float], b: list[float]) -> float:
    """Angle between two directions from the origin, where the objects stand."""
    cosine = sum(x * y for x, y in zip(a, b, strict=True)) / (math.hypot(*a) * math.hypot(*b))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def run(scene: Path, views: int, seed: int, arm: str) -> dict[str, Any]:
    """One run in a process of its own, and its held-out figures."""
    ids = photos(scene, views, seed)
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--view-ids", ",".join(map(str, ids)), "--seed", str(seed), "--lambda_sds", "0", "--threads", "1"]
        flags += ["--checkpoint-every", "0", "--preview-every", "0", *FLAGS.get(arm, [])]
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", f"{folder}/run", *flags]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        metrics = json.loads(Path(folder, "run", "metrics.json").read_text())
        symmetry = json.loads(Path(folder, "run", "config.json").read_text())["symmetry"]
    return {
        **{"scene": scene.name, "views": views, "seed": seed, "arm": arm, "view_ids": ids},
        **{name: metrics["mean"][name] for name in METRICS},
        "cpu_seconds": metrics["train_cpu_seconds"],
        "symmetry": [one["about"] for one in symmetry],
    }


def table(runs: list[dict[str, Any]], views: int, arms: list[str]) -> str:
    """A row per object, seeds averaged, and the paired mean."""
    lines = [f"| object | {arms[0]}, dB | {arms[1]}, dB | LPIPS | difference, dB | worst seed |", "| --- " * 6 + "|"]
    gains, pairs, worst = [], 0, math.inf
    for name in sorted({one["scene"] for one in runs}):
        before, after = (
            {one["seed"]: one for one in runs if (one["scene"], one["views"], one["arm"]) == (name, views, arm)}
            for arm in arms
        )
        seeds = sorted(before.keys() & after.keys())
        each = [after[seed]["psnr"] - before[seed]["psnr"] for seed in seeds]
        if not seeds:
            continue
        gains.append(sum(each) / len(each))
        pairs, worst = pairs + len(each), min(worst, *each)
        psnr, lpips = (
            [sum(side[seed][key] for seed in seeds) / len(seeds) for side in (before, after)]
            for key in ("psnr", "lpips_alex")
        )
        lines.append(
            f"| {name} | {psnr[0]:.2f} | {psnr[1]:.2f} | {lpips[0]:.3f} -> {lpips[1]:.3f} | {gains[-1]:+.2f} "
            f"| {min(each):+.2f} |"
        )
    mean = sum(gains) / len(gains)
    error = math.sqrt(sum((gain - mean) ** 2 for gain in gains) / max(1, len(gains) - 1) / len(gains))
    said = f"{len(gains)} objects, {pairs} pairs: {mean:+.2f} +- {error:.2f} dB, worst pair {worst:+.2f} dB"
    return "\n".join([*lines, f"\nMean over {said}."])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--arm", default="default")
    parser.add_argument("--compare", nargs=2)
    options = parser.parse_args()
    document = json.loads(options.o.read_text()) if options.o.exists() else {"runs": []}
    known = {(one["scene"], one["views"], one["seed"], one["arm"]) for one in document["runs"]}
    for seed, views in ((seed, views) for seed in range(options.seeds) for views in options.views):
        for scene in scenes(options.scenes):
            if (scene.name, views, seed, options.arm) not in known:
                document["runs"].append(run(scene, views, seed, options.arm))
                write_atomic(options.o, to_json({**document, "machine": machine()}))
    for views in options.views if options.compare else []:
        print(f"\n{views} photos\n\n{table(document['runs'], views, options.compare)}")


if __name__ == "__main__":
    main()
