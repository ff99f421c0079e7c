"""Compares a scene in cells with one run of as many Gaussians: held-out PSNR, the same at the seams, and memory.

    python experiments/cells.py NAME DATA CELLS --work DIR [--draw] [-- FLAGS of gsopt train]

"seams": pixels of held-out views that show a place within 5 % of the scene's width of a border between cells, by the
depth of the one run; their squared errors are pooled. Memory is looked at ten times a second: the largest process, and
driver and run together. --draw rewrites the table of docs/howto/cluster.md and writes pictures of the seams to DIR.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import View, load_scene
from gsopt.events import to_json, write_atomic
from gsopt.farm.worker import resident, tree
from gsopt.formats import load_splats
from gsopt.raster.api import rasterize
from gsopt.results.clean import input_psnr
from gsopt.results.finished_run import FinishedRun, open_run, truth
from gsopt.training.cells.plan import CellPlan, read_plan

HERE = Path(__file__).resolve().parent
RESULT, PAGE = HERE / "results/cells.json", HERE.parent / "docs/howto/cluster.md"
NEAR = 0.05
TAIL = 0.05


def trained(data: Path, run: Path, flags: list[str]) -> dict[str, float]:
    """Trains where that is not done, and returns the most bytes seen: of a process, and of all."""
    record = run.with_suffix(".json")
    if record.exists():
        return dict(json.loads(record.read_text()))
    words = [sys.executable, "-m", "gsopt", "train", str(data), "-m", str(run), "--threads", "1", *flags]
    process, most = subprocess.Popen(words), {"process": 0.0, "all": 0.0}
    while process.poll() is None:
        most["all"] = max(most["all"], resident(process.pid))
        most["process"] = max(most["process"], *(own_memory(pid) for pid in tree(process.pid)))
        time.sleep(0.1)
    if process.returncode:
        sys.exit(f"{' '.join(words)} failed")
    write_atomic(record, to_json(most))
    return most


def own_memory(pid: int) -> int:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError):
        return 0
    return pages * 4096


@torch.no_grad()
def at_seams(run: FinishedRun, plan: CellPlan, widths: Float[Tensor, "2"], view: View) -> Bool[Tensor, "H W"]:
    """True for pixels near a border between cells, by the depth of `run`."""
    camera = view.camera.to(torch.float32)
    drawn = rasterize(run.gaussians, camera, run.settings, depth=True, backend=run.backend)
    assert drawn.depths is not None
    depth, (height, width) = drawn.depths[0, ..., 0].double(), drawn.depths.shape[1:3]
    K, pose = camera.Ks[0].double(), camera.viewmats[0].double()
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=2)
    points = (rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
    places = plan.places(points.reshape(-1, 3))
    near = torch.zeros(len(places), dtype=torch.bool)
    for cell in plan.cells:
        for axis in range(2):
            other = 1 - axis
            beside = (places[:, other] >= cell.low[other]) & (places[:, other] < cell.high[other])
            for bound in (cell.low[axis], cell.high[axis]):
                if math.isfinite(bound):
                    near |= beside & ((places[:, axis] - bound).abs() <= NEAR * widths[axis])
    return near.reshape(height, width) & (drawn.alphas[0, ..., 0] > 0.5)


def compared(cells: Path, one: Path, pictures: Path) -> dict[str, Any]:
    """Pooled PSNR at the seams and elsewhere of both runs; pictures with the seams marked."""
    runs = {"cells": open_run(cells, threads=1), "one": open_run(one, threads=1)}
    scene = load_scene(runs["one"].config.data)
    names = {view.name: view for view in scene.train}
    count = len(list((cells / "cells").iterdir()))
    plan = read_plan(cells / "plan.json", cells / "coarse" / "splat.ply", names, count)
    places = plan.places(runs["one"].gaussians.means).sort(dim=0).values
    margin = int(TAIL * len(places))
    widths = places[-1 - margin] - places[margin]
    sums = {(arm, where): [0.0, 0] for arm in runs for where in ("seams", "elsewhere")}
    for number, view in enumerate(scene.test):
        near, seen = at_seams(runs["one"], plan, widths, view), truth(view, runs["one"].background)
        drawn = {arm: run.draw(view.camera) for arm, run in runs.items()}
        for arm, image in drawn.items():
            errors = ((image.double() - seen.double()) / 255).square().mean(2)
            for where, chosen in (("seams", near), ("elsewhere", ~near)):
                sums[arm, where][0] += float(errors[chosen].sum())
                sums[arm, where][1] += int(chosen.sum())
        marked = torch.where(near[..., None], drawn["cells"], drawn["cells"] // 3)
        sheet = torch.cat([seen, drawn["one"], drawn["cells"], marked.to(torch.uint8)], dim=1)
        Image.fromarray(sheet.numpy()).save(pictures / f"seams-{number:02d}.png")
    found = {f"{arm} {where}": round(-10 * math.log10(s / max(1, n)), 3) for (arm, where), (s, n) in sums.items()}
    share = sums["one", "seams"][1] / (sums["one", "seams"][1] + sums["one", "elsewhere"][1])
    return {**found, "share of pixels at seams": round(share, 3)}


def measured(name: str, data: Path, cells: int, work: Path, flags: list[str]) -> dict[str, Any]:
    """The record of a scene."""
    work.mkdir(parents=True, exist_ok=True)
    runs = {"cells": work / f"{name}-cells", "one": work / f"{name}-one"}
    memory = {"cells": trained(data, runs["cells"], ["--cells", str(cells), *flags])}
    metrics = {"cells": json.loads((runs["cells"] / "metrics.json").read_bytes())}
    same = ["--max-gaussians", str(metrics["cells"]["n_gaussians"])]
    memory["one"] = trained(data, runs["one"], [*without(flags, "--max-gaussians"), *same])
    metrics["one"] = json.loads((runs["one"] / "metrics.json").read_bytes())
    record: dict[str, Any] = {"name": name, "cells": cells, "flags": flags, "views": len(metrics["one"]["per_view"])}
    for arm, key in (("cells", "cells_run"), ("one", "one")):
        record[key] = {
            "psnr": metrics[arm]["mean"]["psnr"],
            "gaussians": metrics[arm]["n_gaussians"],
            "cpu_seconds": metrics[arm]["train_cpu_seconds"],
            "memory_mb": {part: round(value / 1e6) for part, value in memory[arm].items()},
        }
    recorded = json.loads((runs["cells"] / "config.json").read_bytes())
    record["stages"] = {
        stage: {key: facts[key] for key in ("n", "steps", "cpu_seconds", "peak_memory_mb")}
        for stage, facts in recorded["stages"].items()
    }
    merged = load_splats(runs["cells"] / "polish" / "start.ply")
    finished = open_run(runs["cells"], threads=1)
    record["unpolished_psnr"] = round(input_psnr(finished, merged, load_scene(finished.config.data).test), 3)
    return {**record, **compared(runs["cells"], runs["one"], work), "machine": machine()}


def without(flags: list[str], name: str) -> list[str]:
    """Flags less one that has a value."""
    at = flags.index(name) if name in flags else len(flags)
    return flags[:at] + flags[at + 2 :]


def drawn(records: list[dict[str, Any]]) -> str:
    """A row for each scene."""
    head = ["scene", "cells", "Gaussians, cells / one run", "PSNR, one run", "cells", "at seams", "elsewhere"]
    head += ["before the polish", "CPU time", "memory of the largest process", "before the polish"]
    rows = []
    for record in records:
        one, cells = record["one"], record["cells_run"]
        memory = one["memory_mb"]["process"]
        before = max(facts["peak_memory_mb"] for name, facts in record["stages"].items() if name != "polish")
        seams, rest = (record[f"cells {where}"] - record[f"one {where}"] for where in ("seams", "elsewhere"))
        rows.append([
            record["name"], str(record["cells"]), f"{cells['gaussians']:,} / {one['gaussians']:,}",
            f"{one['psnr']:.2f} dB", f"{cells['psnr'] - one['psnr']:+.2f} dB", f"{seams:+.2f} dB", f"{rest:+.2f} dB",
            f"{record['unpolished_psnr'] - one['psnr']:+.2f} dB", f"x {cells['cpu_seconds'] / one['cpu_seconds']:.2f}",
            f"{cells['memory_mb']['process'] / memory:.0%} of {memory} MB", f"{before / memory:.0%}",
        ])  # fmt: skip
    return table(head, rows)


def main() -> None:
    at = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?")
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("cells", nargs="?", type=int)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args(sys.argv[1:at])
    torch.set_num_threads(1)
    record = measured(flags.name, flags.data, flags.cells, flags.work, sys.argv[at + 1 :]) if flags.name else None
    document = json.loads(RESULT.read_text()) if RESULT.exists() else {"scenes": []}
    if record is not None:
        document["scenes"] = [old for old in document["scenes"] if old["name"] != flags.name] + [record]
        print(json.dumps(record, indent=1))
        write_atomic(RESULT, to_json(document))
    print(drawn(document["scenes"]))
    if flags.draw:
        replace_block(PAGE, "cells", drawn(document["scenes"]))


if __name__ == "__main__":
    main()
