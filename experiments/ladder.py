"""Measures the best picture within 15 and 30 seconds, 1, 3, 6 and 15 minutes.

    python experiments/ladder.py SCENE... [--name fox] [--steps 500 1000 2000 4000 8000 16000] [--flags -r 4 --eval]
    python experiments/ladder.py --table

Every run is one `gsopt train` with the defaults but for its steps, in a process of its own, on all cores of an idle
machine. Its seconds are those from the start of the process until splat.ply is written: imports, reading of images and
first Gaussians count, judging does not. PSNR, SSIM and LPIPS are means over the held-out views. The last run of a scene
is the first that takes longer than the last rung. Runs that have a record are not made again. --table prints, for every
time, the run with the best PSNR among those that ended within it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic

RUNGS = {"15 s": 15, "30 s": 30, "1 min": 60, "3 min": 180, "6 min": 360, "15 min": 900}
STEPS = (250, 500, 1000, 2000, 4000, 8000, 16000)
METRICS = ("psnr", "ssim", "lpips_alex")
RESULT = Path(__file__).parent / "results" / "ladder.json"


def run(scene: Path, name: str, steps: int, flags: list[str]) -> dict[str, Any]:
    """One run: its steps, seconds, Gaussians, memory and held-out metrics."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder, "run")
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", str(where), "--iterations", str(steps)]
        began = time.time()
        subprocess.run([*command, "--checkpoint-every", "0", *flags], check=True, stdout=subprocess.DEVNULL)
        seconds = (where / "splat.ply").stat().st_mtime - began
        metrics = json.loads((where / "metrics.json").read_text(encoding="utf-8"))
    return {
        **{"scene": name, "steps": steps, "seconds": round(seconds, 1), "flags": flags},
        **{metric: metrics["mean"][metric] for metric in METRICS},
        **{"gaussians": metrics["n_gaussians"], "peak_memory_mb": metrics["peak_memory_mb"]},
    }


def table(runs: list[dict[str, Any]]) -> str:
    """A row per scene: within each time the best PSNR, with the steps and LPIPS of that run."""
    lines = ["| scene | " + " | ".join(RUNGS) + " |", "| --- " * (1 + len(RUNGS)) + "|"]
    for name in dict.fromkeys(one["scene"] for one in runs):
        cells = []
        for limit in RUNGS.values():
            within = [one for one in runs if one["scene"] == name and one["seconds"] <= limit]
            best = max(within, key=lambda one: one["psnr"], default=None)
            cells.append("" if best is None else cell(best))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cell(one: dict[str, Any]) -> str:
    """PSNR, LPIPS, steps and seconds of a run, for the table."""
    cost = f"{one['steps']:,} steps, {one['seconds']:.0f} s"
    return f"**{one['psnr']:.2f}** dB, {one['lpips_alex']:.3f} ({cost})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--name", default="", help="of the scene in the table; its folder's when not given")
    parser.add_argument("--steps", type=int, nargs="*", default=STEPS)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--flags", nargs=argparse.REMAINDER, default=[], help="further flags of gsopt train; last")
    options = parser.parse_args()
    document = json.loads(options.o.read_text(encoding="utf-8")) if options.o.exists() else {"runs": []}
    for scene in options.scenes:
        name = options.name or scene.name
        for steps in options.steps:
            known = [one for one in document["runs"] if one["scene"] == name and one["steps"] == steps]
            record = known[0] if known else run(scene, name, steps, options.flags)
            document["runs"] += [] if known else [record]
            write_atomic(options.o, to_json({**document, "machine": machine(), "cores": os.cpu_count()}))
            if record["seconds"] > max(RUNGS.values()):
                break
    if options.table:
        print(table(document["runs"]))


if __name__ == "__main__":
    main()
