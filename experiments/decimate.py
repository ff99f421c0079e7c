"""Measures what fewer splats cost: merged, left out by what they contribute, or both, as `gsopt export --decimate`.

    python experiments/decimate.py RUN... [--draw] [-o FILE.json]

PSNR of the held-out views of each RUN with a half and a quarter of its splats, against all. "merged": neighbors,
without views, as for a splat file; "left out": those that contribute least to the input views; "both": half of what
goes is left out, the rest merged by contribution, as for a run. --draw rewrites the table of docs/howto/formats.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import mean
from typing import Any

import torch

from gsopt.benchmark.machine import machine
from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import load_scene
from gsopt.events import to_json, write_atomic
from gsopt.results.clean import input_psnr, observe
from gsopt.results.decimate import decimated
from gsopt.results.finished_run import open_run

HERE = Path(__file__).resolve().parent
RESULT, PAGE = HERE / "results/decimate.json", HERE.parent / "docs/howto/formats.md"
SHARES = (0.5, 0.25)
ARMS = ("merged", "left out", "both")


def measured(path: Path) -> dict[str, Any]:
    """The record of a run: change in dB by share and arm."""
    run = open_run(path, threads=1)
    scene = load_scene(run.config.data)
    splats = run.gaussians
    weights = observe(splats, scene.train, run.backend).weight
    record: dict[str, Any] = {"run": path.name, "views": len(scene.train), "splats": len(splats)}
    record["psnr"] = input_psnr(run, splats, scene.test)
    for share in SHARES:
        most = weights.argsort(descending=True, stable=True)[: round(share * len(splats))].sort().values
        found = (decimated(splats, share), splats.select(most), decimated(splats, share, weights))
        changes = [round(input_psnr(run, fewer, scene.test) - record["psnr"], 3) for fewer in found]
        record[f"{share:.0%}"] = dict(zip(ARMS, changes, strict=True))
    return record


def drawn(runs: list[dict[str, Any]]) -> str:
    """A row for each run, and their mean."""
    columns = [(f"{share:.0%}", arm) for share in SHARES for arm in ARMS]
    rows = [
        [run["run"], f"{run['splats']:,}", f"{run['psnr']:.2f}", *(f"{run[share][arm]:+.2f}" for share, arm in columns)]
        for run in runs
    ]
    rows.append(["mean", "", "", *(f"{mean(run[share][arm] for run in runs):+.2f}" for share, arm in columns)])
    return table(["run", "splats", "held-out PSNR, dB", *(f"{share}: {arm}" for share, arm in columns)], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args()
    torch.set_num_threads(1)
    document = json.loads(flags.o.read_text()) if flags.o.exists() else {"runs": []}
    for path in flags.runs:
        if path.name not in {run["run"] for run in document["runs"]}:
            document["runs"].append(measured(path))
            print(document["runs"][-1], flush=True)
            write_atomic(flags.o, to_json({**document, "machine": machine()}))
    print(drawn(document["runs"]))
    if flags.draw:
        replace_block(PAGE, "decimate", drawn(document["runs"]))


if __name__ == "__main__":
    main()
