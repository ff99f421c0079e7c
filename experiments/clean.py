"""What does `gsopt clean` change in views that it does not see?

    python experiments/clean.py RUN... [--draw]

For each finished run with held-out views, this prints how many splats go by each rule, and the PSNR of the held-out
views before and after. Nothing is written into the runs. `--draw` rewrites the table of docs/howto/clean.md and
results/clean.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from gsopt.benchmark.markdown import replace_block, table
from gsopt.data.scene import load_scene
from gsopt.events import write_atomic
from gsopt.results.clean import findings, input_psnr, kept
from gsopt.results.finished_run import open_run

HERE = Path(__file__).resolve().parent
RESULT, PAGE = HERE / "results/clean.json", HERE.parent / "docs/howto/clean.md"


def measured(path: Path) -> dict:
    run = open_run(path)
    scene = load_scene(run.config.data)
    found = findings(run, scene.train)
    keep = kept(found, len(run.gaussians))
    before = input_psnr(run, run.gaussians, scene.test)
    after = input_psnr(run, run.gaussians.select(keep), scene.test)
    rules = {finding.rule: int(finding.splats.sum()) for finding in found if finding.followed}
    return {
        "run": path.name,
        "views": len(scene.train),
        "held_out_views": len(scene.test),
        "splats": len(keep),
        "gone": rules,
        "psnr": round(before, 4),
        "change": round(after - before, 4),
    }


def draw(records: list[dict]) -> None:
    rows = []
    for r in records:
        gone = sum(r["gone"].values())
        rules = ", ".join(f"{rule} {count:,}" for rule, count in r["gone"].items())
        share = f"{gone:,} ({gone / r['splats']:.1%})"
        figures = [share, rules, f"{r['psnr']:.2f}", f"{r['change']:+.4f}"]
        rows.append([r["run"], str(r["views"]), *figures])
    head = ["run", "input views", "splats that go", "by rule", "held-out PSNR, dB", "change, dB"]
    replace_block(PAGE, "clean", table(head, rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--draw", action="store_true")
    flags = parser.parse_args()
    records = []
    for path in flags.runs:
        records.append(measured(path))
        print(records[-1], flush=True)
    if flags.draw:
        write_atomic(RESULT, (json.dumps(records, indent=1) + "\n").encode())
        draw(records)


if __name__ == "__main__":
    main()
