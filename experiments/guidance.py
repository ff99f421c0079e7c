"""Measures the effect of guidance on objects that no prior was trained on: runs with and without it, held-out metrics.

    python experiments/guidance.py SCENES... [-o FILE.json] [--arm off default ...] [--views 4 6 8] [--seeds 3]
                                  [--prior PRIOR] [--iterations 2000] [--draw]

SCENES are posed scenes with held-out views, or folders of them. Every arm is one run from the same first Gaussians with
the same steps; runs with a record in FILE are not repeated. The table pairs every arm with `off`, object by
object: the mean over objects and seeds, and the standard error over objects, whose seeds are averaged first. --draw
writes it from FILE into docs/howto/guidance.md without running anything.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import time
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.cli import main as gsopt
from gsopt.events import to_json, write_atomic

UNGUARDED = ["--lambda-sds", "0.2", "--guidance.guard-views", "0"]
SDS = ["--guidance.policy", "sds", *UNGUARDED]
ARMS: dict[str, list[str]] = {
    "off": ["--lambda-sds", "0"],
    "default": ["--lambda-sds", "0.2"],
    "recon": ["--guidance.policy", "recon", *UNGUARDED],
    "sds": SDS,
    "sds, words": [*SDS, "--guidance.references", "0", "--guidance.image-weight", "0"],
}
"""`words`: the prior gets the object's name instead of input views. `default`: with the guard, as a run is guided where
somebody asks for it; the others without."""
NAMES = {
    "off": "unguided",
    "default": "guarded",
    "recon": "recon, the policy that is taken by itself",
    "sds": "SDS that sees the input views",
    "sds, words": "SDS that sees the object's name, no views",
}
METRICS = ("psnr", "ssim", "lpips_alex")
PAGE = Path(__file__).parents[1] / "docs" / "howto" / "guidance.md"
RESULT = Path(__file__).parent / "results" / "guidance.json"


def scenes(roots: list[Path]) -> list[Path]:
    """Folders with held-out views."""
    found = [p for root in roots for p in (root, *sorted(root.iterdir()))]
    return [p for p in found if (p / "transforms_test.json").is_file()]


def run(scene: Path, views: int, seed: int, arm: str, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The record of one run."""
    shutil.rmtree(folder, ignore_errors=True)
    flags = ["--views", str(views), "--seed", str(seed), "--iterations", str(options.iterations), "--threads", "1"]
    flags += ["--checkpoint-every", "0", "--preview-every", "0", *ARMS[arm]]
    if arm == "sds, words":
        flags += ["--prompt", json.loads((scene / "object.json").read_text())["name"]]
    if arm != "off" and options.prior:
        flags += ["--prior", options.prior]
    began = time.process_time()
    code = gsopt(["train", str(scene), "-m", str(folder), *flags])
    if code:
        raise SystemExit(f"{scene.name}, {views} views, {arm}: gsopt train ended with {code}")
    metrics = json.loads((folder / "metrics.json").read_text())
    summary = folder / "guidance" / "summary.json"
    if arm not in ("off", "default") and not summary.exists():
        raise SystemExit(f"{scene.name}, {views} views, {arm}: the run was not guided.")
    return {
        "scene": scene.name,
        "views": views,
        "seed": seed,
        "arm": arm,
        "iterations": options.iterations,
        **{name: metrics["mean"][name] for name in METRICS},
        "cpu_seconds": round(time.process_time() - began, 1),
        "n_gaussians": metrics["n_gaussians"],
        "guidance": json.loads(summary.read_text()) if summary.exists() else None,
    }


def key(record: dict[str, Any]) -> str:
    return f"{record['scene']} {record['views']} {record['seed']} {record['arm']} {record['iterations']}"


def draw(records: list[dict[str, Any]]) -> str:
    """Markdown: every arm against `off`, by number of input views."""
    off = {(r["scene"], r["views"], r["seed"]): r for r in records if r["arm"] == "off"}
    rows = []
    for views in sorted({r["views"] for r in records}):
        for arm in dict.fromkeys(r["arm"] for r in records):
            mine = [r for r in records if r["views"] == views and r["arm"] == arm]
            pairs = [(r, off[r["scene"], views, r["seed"]]) for r in mine if (r["scene"], views, r["seed"]) in off]
            if not pairs:
                continue
            seconds = sum(a["cpu_seconds"] for a, _ in pairs) / len(pairs)
            if arm == "off":
                level = {name: sum(a[name] for a, _ in pairs) / len(pairs) for name in METRICS}
                cells = [f"{level['psnr']:.2f} dB", "", f"{level['ssim']:.4f}", f"{level['lpips_alex']:.4f}"]
            else:
                (psnr, worst), (ssim, _), (lpips, _) = (changed(pairs, name) for name in METRICS)
                cells = [psnr, f"{worst:+.2f}", ssim, lpips]
            rows.append([f"{views}", NAMES[arm], f"{len(pairs)}", *cells, f"{seconds:.0f}"])
    return table(["views", "arm", "runs", "ΔPSNR, dB", "worst run", "ΔSSIM", "ΔLPIPS Alex", "CPU s"], rows)


def changed(pairs: list[tuple[dict[str, Any], dict[str, Any]]], name: str) -> tuple[str, float]:
    """Mean and standard error over objects of a metric's change, and the lowest of a run."""
    digits = 2 if name == "psnr" else 4
    scenes = {a["scene"] for a, _ in pairs}
    by_scene = [[a[name] - b[name] for a, b in pairs if a["scene"] == scene] for scene in sorted(scenes)]
    change = [sum(values) / len(values) for values in by_scene]
    mean = sum(change) / len(change)
    error = math.sqrt(sum((c - mean) ** 2 for c in change) / max(1, len(change) - 1) / len(change))
    return f"{mean:+.{digits}f} ± {error:.{digits}f}", min(min(values) for values in by_scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", "--out", type=Path, default=RESULT)
    parser.add_argument("--arm", nargs="*", choices=list(ARMS), default=["off", "default"])
    parser.add_argument("--views", type=int, nargs="*", default=[4, 6, 8])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--prior", default="")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--runs", type=Path, default=Path("runs/guidance"))
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    document: dict[str, Any]
    document = json.loads(options.out.read_text()) if options.out.exists() else {"machine": machine(), "runs": []}
    known = {key(record): record for record in document["runs"]}
    for seed in range(0 if options.draw else options.seeds):
        for scene in scenes(options.scenes):
            for views in options.views:
                for arm in options.arm:
                    wanted = {"scene": scene.name, "views": views, "seed": seed, "arm": arm}
                    name = key({**wanted, "iterations": options.iterations})
                    if name in known:
                        continue
                    known[name] = run(scene, views, seed, arm, options, options.runs / name.replace(" ", "_"))
                    write_atomic(options.out, to_json({**document, "runs": list(known.values())}))
    print(draw(list(known.values())))
    if options.draw:
        replace_block(PAGE, "guidance", draw(list(known.values())))


if __name__ == "__main__":
    main()
