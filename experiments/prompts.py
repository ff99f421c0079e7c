"""Measures the effect of prompts: one guided run without them and with those of a user, a template, a language model.

    python experiments/prompts.py SCENES... [-o experiments/results/prompts.json] [--notes FILE]
                                 [--prior PRIOR] [--llm URL --model NAME] [--views 4] [--seeds 3] [--iterations 2000]

SCENES are posed scenes with held-out views, or folders of them; the notes file has an expert's notes for each, by
the name of its folder. Everything but the prompts is the same in every arm; `off` is the run without guidance. Runs
with a record in the result file are not repeated. --draw prints the table from that file without running anything.

A prior without a text encoder gives the same bits with any prompts: the result file records it in `takes_words`, and
its table is no evidence about prompts.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import time
from pathlib import Path
from typing import Any

from gsopt.benchmark.machine import machine
from gsopt.cli import main as gsopt
from gsopt.events import to_json, write_atomic
from gsopt.sds.prompts import read_set, write_prompts

HERE = Path(__file__).resolve().parent
METRICS = {"psnr": "PSNR", "ssim": "SSIM", "lpips_alex": "LPIPS"}
ARMS = ("off", "none", "user", "template", "llm")


def scenes(roots: list[Path]) -> list[Path]:
    """Folders with held-out views."""
    found = [p for root in roots for p in (root, *sorted(q for q in root.iterdir() if q.is_dir()))]
    return [p for p in found if (p / "transforms_test.json").is_file()]


def write_arm(scene: Path, arm: str, note: dict[str, str], options: argparse.Namespace) -> Path | None:
    """The arm's prompts.json in the folder of runs, generated once per scene, or None for an arm without prompts."""
    path: Path = options.runs / f"{scene.name}-{arm}.json"
    if arm in ("off", "none"):
        return None
    if path.exists():
        return path
    made = path.with_name(f"{path.stem}-all.json")
    flags = ["--notes", note["notes"], "--domain", note.get("domain", "generic"), "-o", str(made), "--force"]
    flags += ["--category", note["category"]] if "category" in note else []
    if arm == "llm":
        flags += ["--llm", options.llm, "--model", options.model, "--timeout", str(options.timeout)]
    require(gsopt(["prompts", *flags]), f"prompts of {scene.name}, {arm}")
    source = {"user": "user", "template": "template", "llm": "llm:"}[arm]
    chosen = [prompt for prompt in read_set(made).prompts if prompt.source.startswith(source)]
    write_prompts(path, chosen)
    return path


def run(scene: Path, seed: int, arm: str, note: dict[str, str], options: argparse.Namespace) -> dict[str, Any]:
    """The record of one training run."""
    folder: Path = options.runs / f"{scene.name}-{options.views}-{seed}-{arm}"
    shutil.rmtree(folder, ignore_errors=True)
    flags = ["--views", str(options.views), "--seed", str(seed), "--iterations", str(options.iterations)]
    flags += ["--threads", str(options.threads), "--checkpoint-every", "0", "--preview-every", "0", *options.flag]
    prompts = write_arm(scene, arm, note, options)
    flags += ["--lambda-sds", "0" if arm == "off" else str(options.lambda_sds)]
    flags += ["--prior", options.prior] if arm != "off" else []
    flags += ["--prompts", str(prompts)] if prompts is not None else []
    began = time.process_time()
    require(gsopt(["train", str(scene), "-m", str(folder), *flags]), f"{scene.name}, seed {seed}, {arm}")
    metrics = json.loads((folder / "metrics.json").read_text())
    return {
        "scene": scene.name,
        "views": options.views,
        "seed": seed,
        "arm": arm,
        "iterations": options.iterations,
        **{name: metrics["mean"][name] for name in METRICS},
        "cpu_seconds": round(time.process_time() - began, 1),
        "prompts": [] if prompts is None else [prompt.text for prompt in read_set(prompts).prompts],
    }


def require(code: int, what: str) -> None:
    if code:
        raise SystemExit(f"{what}: gsopt ended with {code}")


def takes_words(prior: str) -> bool:
    """True when the prior has a text encoder."""
    from gsopt.config.guidance import GuidanceConfig
    from gsopt.sds.load_prior import open_prior

    return open_prior(prior, GuidanceConfig(prior=prior)).encoder() is not None


def key(record: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(record[name] for name in ("scene", "views", "seed", "arm", "iterations"))


def draw(document: dict[str, Any]) -> str:
    """Markdown: mean and spread over scenes and seeds of each arm, and its difference to no prompts run by run."""
    records = document["runs"]
    none = {key(record)[:3]: record for record in records if record["arm"] == "none"}
    titles = [f"{title} (spread) | Δ to none" for title in METRICS.values()]
    lines = [f"| prompts | runs | {' | '.join(titles)} |", "|---" * (2 + 2 * len(METRICS)) + "|"]
    for arm in (arm for arm in ARMS if any(record["arm"] == arm for record in records)):
        rows = [record for record in records if record["arm"] == arm]
        cells = [arm, str(len(rows))]
        for name in METRICS:
            values = [row[name] for row in rows if row[name] is not None]
            paired = [row for row in rows if key(row)[:3] in none and row[name] is not None]
            changes = [row[name] - none[key(row)[:3]][name] for row in paired]
            digits = 2 if name == "psnr" else 4
            cells.append(
                f"{statistics.mean(values):.{digits}f} ({statistics.pstdev(values):.{digits}f})" if values else ""
            )
            cells.append(f"{statistics.mean(changes):+.{digits}f}" if changes else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", "--out", type=Path, default=HERE / "results" / "prompts.json")
    parser.add_argument("--notes", type=Path, default=HERE / "prompts_notes.json")
    parser.add_argument("--arm", nargs="*", choices=ARMS, default=None)
    parser.add_argument("--prior", default="embedded")
    parser.add_argument("--lambda-sds", type=float, default=0.2)
    parser.add_argument("--llm", default="")
    parser.add_argument("--model", default="")
    parser.add_argument("--timeout", type=float, default=600.0)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--flag", nargs="*", default=[], help="further flags of gsopt train, e.g. --flag=--resolution=2"
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/prompts"))
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    document = json.loads(options.out.read_text()) if options.out.exists() else {"machine": machine(), "runs": []}
    if not options.draw:
        measure(options, document)
    print(draw(document))


def measure(options: argparse.Namespace, document: dict[str, Any]) -> None:
    """Executes every run without a record and writes the file after each."""
    notes = json.loads(options.notes.read_text())
    arms = options.arm or [arm for arm in ARMS if arm != "llm" or options.llm]
    options.runs.mkdir(parents=True, exist_ok=True)
    words = takes_words(options.prior)
    document |= {"prior": options.prior, "takes_words": words, "lambda_sds": options.lambda_sds}
    if not words:
        print(f"The prior {options.prior} takes no words: prompts cannot change anything.")
    known = {key(record) for record in document["runs"]}
    for seed in range(options.seeds):
        for scene in scenes(options.scenes):
            for arm in arms:
                if (scene.name, options.views, seed, arm, options.iterations) not in known:
                    document["runs"].append(run(scene, seed, arm, notes[scene.name], options))
                    write_atomic(options.out, to_json(document))


if __name__ == "__main__":
    main()
