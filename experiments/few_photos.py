"""How much is an object from one photo worth when its silhouette is inflated, and when it is not?

    python experiments/few_photos.py SCENES... [-o FILE.json] [--seeds 3] [--jobs 2]

SCENES are posed scenes of objects with alpha and held-out views, or folders of them. A seed is a choice of the photo:
one of the input views between 15 and 45 degrees of elevation. Both arms of a pair see the same photo; runs that have a
record in FILE are not made again. The table (held-out PSNR, SSIM and LPIPS, paired per object, standard error over
objects) is printed; docs/howto/photos.md quotes it.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic

ARMS = {"photo alone": ["--sparse.inflate", "off"], "inflated": []}
METRICS = ("psnr", "ssim", "lpips_alex")
ELEVATIONS = (15.0, 45.0)
RESULT = Path(__file__).parent / "results" / "few_photos.json"


def scenes(roots: list[Path]) -> list[Path]:
    """Folders with held-out views."""
    found = [p for root in roots for p in (root, *sorted(root.iterdir()))]
    return [p for p in found if (p / "transforms_test.json").is_file()]


def photo(scene: Path, seed: int) -> int:
    """Row of the input view that a seed chooses."""
    frames = json.loads((scene / "transforms_train.json").read_text())["frames"]
    rows = []
    for row, frame in enumerate(frames):
        x, y, z = (frame["transform_matrix"][axis][3] for axis in range(3))
        if ELEVATIONS[0] <= math.degrees(math.atan2(z, math.hypot(x, y))) <= ELEVATIONS[1]:
            rows.append(row)
    return random.Random(seed).choice(rows)


def run(scene: Path, seed: int, arm: str) -> dict[str, Any]:
    """One run in a process of its own, and its held-out figures."""
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--view-ids", str(photo(scene, seed)), "--seed", str(seed), "--lambda_sds", "0", "--threads", "1"]
        flags += ["--checkpoint-every", "0", "--preview-every", "0", *ARMS[arm]]
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", f"{folder}/run", *flags]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        metrics = json.loads(Path(folder, "run", "metrics.json").read_text())
    figures = {name: metrics["mean"][name] for name in METRICS}
    return {"scene": scene.name, "seed": seed, "arm": arm, **figures, "cpu_seconds": metrics["train_cpu_seconds"]}


def table(runs: list[dict[str, Any]]) -> str:
    """A row per object, seeds averaged, and the paired mean."""
    lines = ["| object | photo alone, dB | inflated, dB | LPIPS | difference, dB | worst seed |", "|---" * 6 + "|"]
    gains = []
    for name in sorted({one["scene"] for one in runs}):
        pairs = {arm: {o["seed"]: o for o in runs if o["scene"] == name and o["arm"] == arm} for arm in ARMS}
        alone, inflated = (pairs[arm] for arm in ARMS)
        seeds = sorted(alone.keys() & inflated.keys())
        each = [inflated[seed]["psnr"] - alone[seed]["psnr"] for seed in seeds]
        if not seeds:
            continue
        gains.append(sum(each) / len(each))
        psnr, lpips = (
            [sum(side[seed][key] for seed in seeds) / len(seeds) for side in (alone, inflated)]
            for key in ("psnr", "lpips_alex")
        )
        lines.append(
            f"| {name} | {psnr[0]:.2f} | {psnr[1]:.2f} | {lpips[0]:.3f} -> {lpips[1]:.3f} | {gains[-1]:+.2f} "
            f"| {min(each):+.2f} |"
        )
    mean = sum(gains) / len(gains)
    error = math.sqrt(sum((gain - mean) ** 2 for gain in gains) / max(1, len(gains) - 1) / len(gains))
    return "\n".join([*lines, f"\nMean over {len(gains)} objects: {mean:+.2f} +- {error:.2f} dB."])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    document = json.loads(options.o.read_text()) if options.o.exists() else {"runs": []}
    known = {(one["scene"], one["seed"], one["arm"]) for one in document["runs"]}
    wanted = [(s, seed, arm) for s in scenes(options.scenes) for seed in range(options.seeds) for arm in ARMS]
    with ThreadPoolExecutor(options.jobs) as pool:
        missing = [one for one in wanted if (one[0].name, *one[1:]) not in known]
        for record in pool.map(lambda one: run(*one), missing):
            document["runs"].append(record)
            write_atomic(options.o, to_json({**document, "machine": machine()}))
    print(table(document["runs"]))


if __name__ == "__main__":
    main()
