"""How many CPU seconds does a run take to a quality, and which settings get there sooner?

    python experiments/time_to_quality.py SCENE... --views 4 --arm default=CHECKOUT --arm early [-o FILE.json]
    python experiments/time_to_quality.py --views 4 --compare default early

SCENE is a posed scene with held-out views, or a folder of them. An arm is a set of flags of `gsopt train` (ARMS), run
with one thread in a process of its own, by the gsopt of a CHECKOUT where one is named, else by this one: arms of one
call are paired, since how fast the machine is changes from hour to hour. A record has the held-out figures, the CPU
seconds of the setup and of the steps, and the curve of PSNR over both at the previews; judging is not counted. Runs
that have a record in FILE are not made again. --compare prints a row per scene: both arms' PSNR, and the CPU seconds
after which each first reaches the first arm's final PSNR less TOLERANCE.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.benchmark.scenes import quality_over_time
from gsopt.data.scene import load_scene
from gsopt.events import read_events, to_json, write_atomic
from gsopt.results.evaluation import evenly_spread
from gsopt.results.finished_run import open_run

FROM_CHECKOUT = """
import sys
checkout = sys.argv.pop(1)
if checkout:
    sys.meta_path[:] = [finder for finder in sys.meta_path if "Inplace" not in type(finder).__name__]
    sys.path.insert(0, checkout)
from gsopt.cli import main
sys.exit(main(sys.argv[1:]))
"""
"""An editable install finds its own modules before those of any path."""
METRICS = ("psnr", "ssim", "lpips_alex")
CURVE_VIEWS = 8
PREVIEWS, PREVIEWS_ALL = 200, 500
"""Steps between two points of a curve, with few views and with all."""
TOLERANCE = 0.1
"""dB; a run's last tenth of a dB takes a third of its time."""
RESULT = Path(__file__).parent / "results" / "time_to_quality.json"


def early(views: int | None) -> list[str]:
    """With few views: density control from a seventh of the run, a shorter coarse phase, half the first Gaussians, and
    350 steps per view instead of 500."""
    count = views or 8
    coarse = ["--schedule.coarse-until", str(29 * count), str(125 * count)]
    steps = ["--sparse.steps-per-view", "350", "--density.refine-start", str(50 * count)]
    return [*steps, *coarse, "--init-count", "10000"]


ARMS = {
    "default": lambda views: [],
    "draft": lambda views: ["--preset", "draft"],
    "high": lambda views: ["--preset", "high"],
    "early": early,
}
"""The results hold further arms, with all views: those of docs/decisions/0016-time-to-quality.md, by `flags`. They took
turns in one process, were judged on 25 held-out views (fox: 7), and count the first Gaussians alone as setup."""


def scenes(roots: list[Path]) -> list[Path]:
    """Folders with a posed dataset."""
    found = [p for root in roots for p in (root, *sorted(root.iterdir()))]
    return [p for p in found if any((p / f"transforms{end}.json").is_file() for end in ("", "_test"))]


def run(scene: Path, views: int | None, seed: int, arm: str, checkout: str, more: list[str]) -> dict[str, Any]:
    """One run, and its curve."""
    with tempfile.TemporaryDirectory() as folder:
        flags = ["--seed", str(seed), "--threads", "1", "--checkpoint-every", "0", "--preview-every"]
        flags += [str(PREVIEWS_ALL if views is None else PREVIEWS)]
        flags += [] if views is None else ["--views", str(views)]
        flags += [*ARMS[arm](views), *more]
        command = [sys.executable, "-c", FROM_CHECKOUT, checkout, "train", str(scene), "-m", f"{folder}/run", *flags]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        finished = open_run(Path(folder, "run"), threads=1)
        events = read_events(finished.path / "events.jsonl")[0]
        metrics = json.loads((finished.path / "metrics.json").read_text())
        held_out = evenly_spread(load_scene(finished.config.data).test, CURVE_VIEWS)
        points = quality_over_time(finished, held_out, events)
    setup = next(event["setup_cpu_seconds"] for event in events if event["kind"] == "started")
    curve = [[p["step"], round(setup + p["cpu_seconds"], 2), p["psnr"], p["gaussians"]] for p in points]
    return {
        **{"scene": scene.name, "views": views, "seed": seed, "arm": arm, "flags": more},
        **{name: metrics["mean"][name] for name in METRICS},
        **{"setup_cpu_seconds": setup, "train_cpu_seconds": metrics["train_cpu_seconds"]},
        "curve": curve,
    }


def seconds_to(curve: list[list[float]], wanted: float) -> float:
    """CPU seconds after which the curve, drawn with straight lines, first reaches a PSNR; infinite if never."""
    before = (0.0, -math.inf)
    for _, seconds, psnr, _ in curve:
        if psnr >= wanted:
            share = 1.0 if math.isinf(before[1]) else (wanted - before[1]) / (psnr - before[1])
            return before[0] + share * (seconds - before[0])
        before = (seconds, psnr)
    return math.inf


def comparison(runs: list[dict[str, Any]], views: int | None, arms: list[str]) -> str:
    """A row per scene and seed, and the paired means."""
    lines = [
        f"| scene | {arms[0]}, dB | {arms[1]}, dB | LPIPS | setup, CPU s | CPU s | to quality |",
        "| --- " * 7 + "|",
    ]
    gains, ratios, lpips = [], [], []
    for name, seed in sorted({(one["scene"], one["seed"]) for one in runs if one["views"] == views}):
        key = {"scene": name, "seed": seed, "views": views}
        both = [[one for one in runs if one.items() >= {**key, "arm": arm}.items()] for arm in arms]
        if not all(both):
            continue
        a, b = (found[0] for found in both)
        wanted = a["curve"][-1][2] - TOLERANCE
        times = [seconds_to(one["curve"], wanted) for one in (a, b)]
        gains.append(b["psnr"] - a["psnr"])
        lpips.append(b["lpips_alex"] - a["lpips_alex"])
        ratios.append(times[0] / times[1])
        setup = " -> ".join(f"{one['setup_cpu_seconds']:.1f}" for one in (a, b))
        whole = " -> ".join(f"{one['curve'][-1][1]:.1f}" for one in (a, b))
        reached = " -> ".join("never" if math.isinf(seconds) else f"{seconds:.1f}" for seconds in times)
        lines.append(
            f"| {name}, seed {seed} | {a['psnr']:.2f} | {b['psnr']:.2f} ({gains[-1]:+.2f}) "
            f"| {a['lpips_alex']:.4f} -> {b['lpips_alex']:.4f} | {setup} | {whole} | {reached} |"
        )
    if not gains:
        return "No pairs."
    mean = sum(gains) / len(gains)
    error = math.sqrt(sum((gain - mean) ** 2 for gain in gains) / max(1, len(gains) - 1) / len(gains))
    known = [ratio for ratio in ratios if ratio > 0]
    speed = math.exp(sum(map(math.log, known)) / len(known)) if known else 0.0
    quality = f"{mean:+.2f} +- {error:.2f} dB, worst {min(gains):+.2f}, LPIPS {sum(lpips) / len(lpips):+.4f}"
    said = f"{len(gains)} pairs: {quality}; {speed:.2f}x as fast in the {len(known)} that reach the quality."
    return "\n".join([*lines, "", said])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--views", type=int)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--arm", action="append", default=[])
    parser.add_argument("--flags", nargs=argparse.REMAINDER, default=[], help="further flags of gsopt train; last")
    parser.add_argument("--compare", nargs=2)
    options = parser.parse_args()
    document = json.loads(options.o.read_text()) if options.o.exists() else {"runs": []}
    known = {(one["scene"], one["views"], one["seed"], one["arm"]) for one in document["runs"]}
    for scene in scenes(options.scenes):
        for seed in range(options.seeds):
            for arm, _, checkout in (named.partition("=") for named in options.arm):
                if (scene.name, options.views, seed, arm) not in known:
                    document["runs"].append(run(scene, options.views, seed, arm, checkout, options.flags))
                    write_atomic(options.o, to_json({**document, "machine": machine()}))
    if options.compare:
        print(comparison(document["runs"], options.views, options.compare))


if __name__ == "__main__":
    main()
