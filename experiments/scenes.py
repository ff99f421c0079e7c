"""Measures quality, time and memory of training on the scenes that README.md and docs/performance.md quote.

    python experiments/scenes.py --root DATA [--case lego-100 ...] [--runs FOLDER]

DATA holds `nerf_synthetic_lego_400` and `fox` (see `CASES`). Every case is one `gsopt train` in a process of its own;
its held-out metrics, wall time, peak memory, the resolved configuration and the machine go into
experiments/results/scenes.json, one record per case. Cases that are not named keep their records.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from gsopt.benchmark.suite.arm_flags import PUBLISHED_SETTINGS

RESULTS = Path(__file__).parent / "results" / "scenes.json"
DEMO, LEGO, FOX = "gsopt/demo", "nerf_synthetic_lego_400", "fox"
# The eight input views of the few-shot protocol (Jain et al. 2021).
EIGHT = ["--view-ids", "2,16,26,55,73,75,86,93"]
CASES: dict[str, tuple[str, list[str]]] = {
    "demo": (DEMO, ["--iterations", "1600", "--lambda-sds", "0"]),  # as `make demo`, which installs no diffusers
    "lego-100": (LEGO, []),
    "lego-100-30k": (LEGO, ["--iterations", "30000"]),
    "lego-8": (LEGO, EIGHT),
    "lego-8-plain-3dgs": (LEGO, [*EIGHT, *PUBLISHED_SETTINGS]),
    "fox-quarter": (FOX, ["-r", "4", "--eval"]),
    "fox-quarter-8": (FOX, ["-r", "4", "--eval", "--views", "8"]),
}
KEPT = ("mean", "per_view", "train_seconds", "peak_memory_mb", "n_gaussians", "protocol", "versions", "config")


def run_case(name: str, root: Path, runs: Path) -> dict[str, Any]:
    """Train one case into `runs`/name and return its record."""
    folder, flags = CASES[name]
    data = Path(folder) if folder == DEMO else root / folder
    command = ["train", str(data), "-m", str(runs / name), "--vgg", *flags]
    subprocess.run([sys.executable, "-m", "gsopt", *command], check=True)
    metrics = json.loads((runs / name / "metrics.json").read_text())
    record = {key: metrics.get(key) for key in KEPT}
    record["config"]["data"]["path"] = folder
    return {"case": name, "flags": flags, **record, "machine": machine()}


def machine() -> dict[str, Any]:
    """Metadata of the machine."""
    cpu = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = models[0] if models else cpu
    return {"cpu": cpu, "cores": os.cpu_count(), "python": platform.python_version(), "system": platform.system()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--case", nargs="*", choices=list(CASES), default=list(CASES))
    parser.add_argument("--runs", type=Path, default=Path("runs/bench"))
    options = parser.parse_args()
    for name in options.case:
        record = run_case(name, options.root, options.runs)
        records = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        RESULTS.write_text(json.dumps({**records, name: record}, indent=1) + "\n")
        print(name, record["mean"], f"{record['train_seconds']:.0f} s", record["n_gaussians"], "Gaussians")


if __name__ == "__main__":
    main()
