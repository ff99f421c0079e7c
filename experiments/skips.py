"""Measures the time and quality that each skip costs at 7000 steps, and writes the table of docs/performance.md.

    python experiments/skips.py --root DATA [--arm lego-plain ...] [--runs FOLDER] [--draw]

DATA holds `nerf_synthetic_lego_400` and `fox`. Arms of each scene: `plain` (every skip off but the kernels' own),
`bare` (those off as well), `all` (every skip on), `free` (the kernels' own and those whose row shows at most
0.1 dB on either scene), `no-X` (every skip but X), and `plain` and `free` again with other seeds. An arm is one
`gsopt train --threads 1` in a process of its own; its CPU time (user and system, all threads, over the training steps
alone) and its held-out metrics go to experiments/results/skips.json. Arms with a record are not measured again, an
interrupted arm continues from its last checkpoint, and a skip that acts late forks from the checkpoint of `all` at
step 4000. --draw writes the table without measuring.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsopt.benchmark import schema
from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.events import to_json, write_atomic

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "experiments" / "results" / "skips.json"
PAGE = ROOT / "docs" / "performance.md"
FORK = 4000
"""Step before the last refinement of 7000 steps; resting views and the flat-loss stop act after it."""
TOGETHER = (("plain", "bare"), ("free", "plain"), ("free", "bare"), ("all", "plain"), ("all", "bare"))
SEEDS = (1, 2)
"""Further seeds of the arms `plain` and `free`."""
METRICS = ("psnr", "ssim", "lpips_alex")
RECORD = {
    "scene": str,
    "arm": str,
    "seed": int,
    "flags": [str],
    "same_as": (str, None),
    "cpu_seconds": float,
    "wall_seconds": float,
    "steps": int,
    "gaussians": int,
    "mean": {name: float for name in METRICS},
    "machine": schema.MACHINE,
}
DOCUMENT = {"command": str, "records": [RECORD]}


@dataclass(frozen=True)
class Skip:
    """One computation that a run may skip."""

    name: str
    what: str
    on: tuple[str, ...]
    off: tuple[str, ...]
    setting: tuple[str, Any] | None = None
    """For a skip that acts only after `FORK`: the key of `schedule` in config.json, and its value when off."""
    needs_masks: bool = False


SKIPS = (
    Skip("budget", "densification budget", (), ("--max-gaussians", "10000000")),
    Skip("coarse", "coarse-to-fine resolution", (), ("--schedule.coarse-until",)),
    Skip(
        "crop",
        "background of masked objects",
        ("--schedule.crop-masked",),
        ("--schedule.no-crop-masked",),
        needs_masks=True,
    ),
    Skip(
        "rest",
        "views that have converged",
        ("--schedule.rest-converged",),
        ("--schedule.no-rest-converged",),
        ("rest_converged", False),
    ),
    Skip(
        "flat",
        "stop when the loss is flat",
        ("--schedule.stop-when-flat",),
        ("--schedule.no-stop-when-flat",),
        ("stop_when_flat", False),
    ),
    Skip("bands", "SH bands by the residual", ("--schedule.bands", "residual"), ("--schedule.bands", "steps")),
)
FREE = ("coarse", "crop", "flat")
"""Skips of `free` besides the kernels' own, by the rows of the table."""
BARE = """
import sys
from gsopt.cli import main
from gsopt.raster.cpu_backend import CpuBackend
made = CpuBackend.__init__
def without_skips(self, threads=0):
    made(self, threads)
    self._workspace.skip_tiles = self._workspace.skip_terminated = False
CpuBackend.__init__ = without_skips
sys.exit(main(sys.argv[1:]))
"""
"""gsopt with the kernels' own skips switched off, for python -c."""
SCENES = {"lego": ("nerf_synthetic_lego_400", (), True), "fox": ("fox", ("-r", "4", "--eval"), False)}
"""Folder, flags, and whether the images carry masks."""
COMMON = ("--threads", "1", "--preview-every", "0", "--lambda-sds", "0")


@dataclass(frozen=True)
class Arm:
    """One run."""

    scene: str
    name: str
    flags: tuple[str, ...]
    without: Skip | None = None
    seed: int = 0

    @property
    def key(self) -> str:
        return key(self.scene, self.name, self.seed)

    def folder(self, runs: Path) -> Path:
        return runs / self.key


def key(scene: str, name: str, seed: int = 0) -> str:
    return f"{scene}-{name}-{seed}" if seed else f"{scene}-{name}"


def arms() -> list[Arm]:
    """Every arm, the most informative first."""
    found = [
        Arm(scene, name, tuple(flag for skip in SKIPS for flag in getattr(skip, way)))
        for scene in SCENES
        for name, way in (("plain", "off"), ("all", "on"))
    ]
    for name, chosen in (("bare", ()), ("free", FREE)):
        flags = tuple(flag for skip in SKIPS for flag in (skip.on if skip.name in chosen else skip.off))
        found += [Arm(scene, name, flags) for scene in SCENES]
    for without in SKIPS:
        flags = tuple(flag for skip in SKIPS for flag in (skip.off if skip is without else skip.on))
        found += [Arm(scene, f"no-{without.name}", flags, without) for scene in SCENES]
    again = [arm for arm in found if arm.name in ("plain", "free")]
    return found + [replace(arm, seed=seed) for seed in SEEDS for arm in again]


def measure(arm: Arm, root: Path, runs: Path, records: dict[str, Any]) -> dict[str, Any] | None:
    """The record of one arm, or None until `all` has one."""
    full = records.get(f"{arm.scene}-all")
    if arm.without is not None and full is None:
        return None
    if arm.without is not None and changes_nothing(arm, runs):
        return {**full, "arm": arm.name, "flags": list(arm.flags), "same_as": "all"} if full else None
    folder, scene_flags, _ = SCENES[arm.scene]
    command = ["train", str(root / folder), *scene_flags, *COMMON, "--seed", str(arm.seed), *arm.flags]
    run = arm.folder(runs)
    if arm.without is not None and arm.without.setting is not None and not run.exists():
        fork(Arm(arm.scene, "all", ()).folder(runs), run, *arm.without.setting)
    if arm.without is not None and arm.without.setting is not None:
        command = ["train", "--threads", "1", "--preview-every", "0"]
    if not (run / "metrics.json").exists():  # it is written last
        start = ["-c", BARE] if arm.name == "bare" else ["-m", "gsopt"]
        finish(arm, [sys.executable, *start, *command, "-m", str(run), "--resume"], run)
    metrics = json.loads((run / "metrics.json").read_bytes())
    return {
        "scene": arm.scene,
        "arm": arm.name,
        "seed": arm.seed,
        "flags": [*scene_flags, *COMMON, *arm.flags],
        "same_as": None,
        "cpu_seconds": metrics["train_cpu_seconds"],
        "wall_seconds": metrics["train_seconds"],
        "steps": metrics["steps"],
        "gaussians": metrics["n_gaussians"],
        "mean": {name: metrics["mean"][name] for name in METRICS},
        "machine": machine(),
    }


def finish(arm: Arm, command: list[str], run: Path) -> None:
    """Starts or continues the run until it is evaluated."""
    process = subprocess.Popen(command)
    while process.poll() is None:
        keep_fork(run)
        time.sleep(1)
    if process.returncode != 0:
        raise SystemExit(f"{arm.key} ended with exit code {process.returncode}; run this again to continue it.")


def changes_nothing(arm: Arm, runs: Path) -> bool:
    """True when the run without this skip equals `all` bit for bit."""
    assert arm.without is not None
    if arm.without.needs_masks and not SCENES[arm.scene][2]:
        return True
    if arm.without.name != "bands":
        return False
    from gsopt.training.checkpoint import read_checkpoint

    kept = Arm(arm.scene, "all", ()).folder(runs) / "fork" / f"step_{FORK:06d}.safetensors"
    return int(read_checkpoint(kept).tensors["bands.degree"]) == 3


def keep_fork(run: Path) -> None:
    """A second name for the checkpoint that later arms start from: a run keeps only its newest two."""
    found, kept = (run / folder / f"step_{FORK:06d}.safetensors" for folder in ("checkpoints", "fork"))
    if found.exists() and not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        os.link(found, kept)


def fork(source: Path, run: Path, setting: str, value: Any) -> None:
    """A run that goes on from `source`'s checkpoint with one setting changed."""
    (run / "checkpoints").mkdir(parents=True)
    document = json.loads((source / "config.json").read_bytes())
    document["config"]["schedule"][setting] = value
    write_atomic(run / "config.json", to_json(document))
    name = f"step_{FORK:06d}.safetensors"
    shutil.copyfile(source / "fork" / name, run / "checkpoints" / name)


def read_records() -> dict[str, Any]:
    if not RESULT.exists():
        return {}
    document = json.loads(RESULT.read_bytes())
    schema.require(document, DOCUMENT, RESULT.name)
    return {key(record["scene"], record["arm"], record["seed"]): record for record in document["records"]}


def write_records(records: dict[str, Any]) -> None:
    document = {"command": "python experiments/skips.py --root DATA", "records": list(records.values())}
    schema.require(document, DOCUMENT)
    write_atomic(RESULT, to_json(document))


def page(records: dict[str, Any]) -> str:
    """The table: each skip by what its absence costs, then all of them together."""
    head = ["skip", "scene", "CPU time saved", "PSNR, dB", "SSIM", "LPIPS (Alex)"]
    rows = []
    for skip in SKIPS:
        for scene in SCENES:
            if both := pairs(records, scene, f"no-{skip.name}", "all"):
                rows.append([skip.what, scene, *difference(both)])
    for name, than in TOGETHER:
        for scene in SCENES:
            if both := pairs(records, scene, than, name):
                factor = sum(slow["cpu_seconds"] for slow, _ in both) / sum(fast["cpu_seconds"] for _, fast in both)
                seeds = f", {len(both)} seeds" if len(both) > 1 else ""
                rows.append([f"**`{name}` for `{than}`: {factor:.2f}x**{seeds}", scene, *difference(both)])
    absolute = [
        [r["scene"], r["arm"], f"{r['cpu_seconds']:.0f} s", f"{r['gaussians']:,}", str(r["steps"]), *figures(r)]
        for key in (f"{scene}-{arm}" for scene in SCENES for arm in ("bare", "plain", "free", "all"))
        if (r := records.get(key))
    ]
    absolute_head = ["scene", "arm", "CPU time", "Gaussians", "steps", "PSNR, dB", "SSIM", "LPIPS (Alex)"]
    return f"{table(absolute_head, absolute)}\n\n{table(head, rows)}"


def figures(record: dict[str, Any]) -> list[str]:
    mean = record["mean"]
    return [f"{mean['psnr']:.2f}", f"{mean['ssim']:.4f}", f"{mean['lpips_alex']:.4f}"]


def pairs(records: dict[str, Any], scene: str, without: str, full: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Records of two arms, seed by seed."""
    keys = [(key(scene, without, seed), key(scene, full, seed)) for seed in (0, *SEEDS)]
    return [(records[a], records[b]) for a, b in keys if a in records and b in records]


def difference(both: list[tuple[dict[str, Any], dict[str, Any]]]) -> list[str]:
    """Savings and changes by a skip, as means over pairs of (run without it, run with it)."""
    if both[0][0]["same_as"]:
        return ["0 (the same run)", "0", "0", "0"]
    without, full = (sum(pair[k]["cpu_seconds"] for pair in both) / len(both) for k in (0, 1))
    changes = {name: [fast["mean"][name] - slow["mean"][name] for slow, fast in both] for name in METRICS}
    mean = {name: sum(values) / len(both) for name, values in changes.items()}
    psnr = f"{mean['psnr']:+.2f}"
    if len(both) > 1:
        psnr += f" ({', '.join(f'{value:+.2f}' for value in changes['psnr'])})"
    share = 100 * (1 - full / without)
    return [f"{without - full:.0f} s ({share:.0f} %)", psnr, f"{mean['ssim']:+.4f}", f"{mean['lpips_alex']:+.4f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = arms()
    parser.add_argument("--root", type=Path)
    parser.add_argument("--arm", nargs="*", choices=[arm.key for arm in every], default=[arm.key for arm in every])
    parser.add_argument("--runs", type=Path, default=Path("runs/skips"))
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    if options.root is None and not options.draw:
        parser.error("--root is needed to measure; --draw alone writes the table")
    for arm in every if options.root is not None else []:
        if arm.key in read_records() or arm.key not in options.arm:
            continue
        record = measure(arm, options.root, options.runs, read_records())
        if record is None:
            print(f"{arm.key} waits for {arm.scene}-all")
            continue
        write_records({**read_records(), arm.key: record})
        print(arm.key, record["mean"], f"{record['cpu_seconds']:.0f} s CPU, {record['gaussians']:,} Gaussians")
    if options.draw:
        replace_block(PAGE, "skips", page(read_records()))


if __name__ == "__main__":
    main()
