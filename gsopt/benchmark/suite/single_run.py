"""One run of a suite: `gsopt train` in a process of its own, and all its figures as one record."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsopt.benchmark.suite import arm_flags, run_key
from gsopt.benchmark.suite.definition import EVALUATIONS, Case
from gsopt.benchmark.suite.result_file import METRICS
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.errors import GsoptError, InputError
from gsopt.events import read_events
from gsopt.metrics import find_vgg_weights
from gsopt.results.evaluation import read_metrics
from gsopt.results.finished_run import open_run
from gsopt.sds.prompts import read_set, write_prompts
from gsopt.sds.select_prior import EMBEDDED, embedded_prior_obstacle

MAX_ERROR_LINES = 12
"""Number of last lines of a failed run's output in its error."""


class RunFailed(GsoptError):
    """`gsopt train` ended with an error; the suite goes on without this run."""

    exit_code = 3


@dataclass(frozen=True)
class SuiteContext:
    """Settings that the runs of one call share."""

    root: Path
    work: Path
    """Folder of the runs; each is removed once its record is written."""
    threads: int
    prior: str = ""
    """Prior of guided arms; gsopt's own choice when empty."""
    llm: str = ""
    model: str = ""


def reason_to_skip(case: Case, context: SuiteContext) -> str | None:
    """Reason to skip a run, or None for a run to execute."""
    if not arm_flags.is_guided(case.arm):
        return None
    missing = None if context.prior else embedded_prior_obstacle()
    if missing is not None:
        return f"the same as ours-0, not guided: no prior at hand: {missing}"
    if case.arm not in arm_flags.PROMPT_SOURCES:
        return None
    return _reason_without_prompts(case, context, context.prior or "embedded")


def _reason_without_prompts(case: Case, context: SuiteContext, prior: str) -> str | None:
    from gsopt.sds.load_prior import open_prior

    if open_prior(prior, GuidanceConfig(prior=prior)).encoder() is None:
        return f"the prior {prior} has no text encoder: prompts cannot change anything"
    if case.arm == "ours-llm" and not context.llm:
        return "no language model given: --llm URL"
    if case.scene not in notes(context.root):
        return f"no notes for {case.scene} in notes.json below the root"
    return None


def notes(root: Path) -> dict[str, Any]:
    """An expert's notes by scene: {"notes": ..., "domain": ..., "category": ...}."""
    from gsopt.data.files import read_json

    path = root / "notes.json"
    return read_json(path) if path.exists() else {}


def data_config(case: Case, root: Path) -> DataConfig:
    """Configuration of the data that the flags of the run describe."""
    flags = list(case.flags)
    after = {name: flags[flags.index(name) + 1] for name in ("--views", "--view-ids", "-r") if name in flags}
    ids = tuple(int(part) for part in after["--view-ids"].split(",")) if "--view-ids" in after else None
    views = int(after["--views"]) if "--views" in after else None
    factor = int(after.get("-r", 1))
    return DataConfig(str(root / case.scene), views=views, view_ids=ids, downscale=factor, eval="--eval" in flags)


def settings(case: Case, context: SuiteContext) -> list[str]:
    """Everything that the run's figures depend on, besides its data and the code."""
    own = [*case.flags, f"looks={EVALUATIONS}"]
    vgg = find_vgg_weights()
    own.append("vgg=" + ("none" if vgg is None else run_key.file_hash(vgg).hex()))
    if arm_flags.is_guided(case.arm):
        folder = Path(context.prior) if context.prior and Path(context.prior).is_dir() else EMBEDDED
        own.append(f"prior={context.prior or 'auto'} {run_key.folder_hash(folder.absolute())}")
    if (path := prompts(case, context)) is not None:
        own.append("prompts=" + run_key.file_hash(path).hex())
    return own


def key(case: Case, context: SuiteContext) -> str:
    """Hash of settings, data and code: a record with the same key is this run."""
    data = run_key.folder_hash((context.root / case.scene).absolute())
    return run_key.key(settings(case, context), data, run_key.code_hash())


def prompts(case: Case, context: SuiteContext) -> Path | None:
    """The arm's prompts.json, generated once per scene, or None for an arm without prompts."""
    if case.arm not in arm_flags.PROMPT_SOURCES:
        return None
    note = notes(context.root)[case.scene]
    inputs = json.dumps([note, context.llm, context.model, run_key.code_hash()]).encode()
    asked = hashlib.sha256(inputs).hexdigest()[:12]
    path = context.work / "prompts" / f"{case.scene.replace('/', '-')}-{case.arm}-{asked}.json"
    if path.exists():
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    every = path.with_name(f"all-{path.name}")
    domain = str(note.get("domain", "generic"))
    if (context.root / domain).is_file():  # a custom template, named relative to notes.json
        domain = str((context.root / domain).absolute())
    command = ["prompts", "--notes", str(note["notes"]), "--domain", domain]
    command += ["--category", str(note["category"])] if "category" in note else []
    command += ["--llm", context.llm, "--model", context.model] if case.arm == "ours-llm" else []
    call([*command, "-o", str(every), "--overwrite"], path.with_suffix(".log"))
    found = read_set(every).prompts
    write_prompts(path, [prompt for prompt in found if prompt.source.startswith(arm_flags.PROMPT_SOURCES[case.arm])])
    return path


def machine_flags(case: Case, context: SuiteContext) -> list[str]:
    """Flags that change the speed of a run and its previews, but no bit of its result."""
    flags = ["--threads", str(context.threads), "--checkpoint-every", "0"]
    flags += ["--preview-every", str(max(1, case.iterations // EVALUATIONS))]
    if arm_flags.is_guided(case.arm) and context.prior:
        flags += ["--prior", context.prior]
    path = prompts(case, context)
    return flags if path is None else [*flags, "--prompts", str(path)]


def call(arguments: list[str], log: Path) -> None:
    """`gsopt ARGUMENTS` with this Python and this package; RunFailed with the end of its output."""
    with open(log, "wb") as output:
        done = subprocess.run(
            [sys.executable, "-m", "gsopt", *arguments],
            cwd=run_key.PACKAGE.parent,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if done.returncode in (-signal.SIGINT, -signal.SIGTERM, 130):
        raise KeyboardInterrupt
    if done.returncode:
        last = log.read_text(encoding="utf-8", errors="replace").splitlines()[-MAX_ERROR_LINES:]
        raise RunFailed(
            f"`gsopt {' '.join(arguments)}` ended with exit code {done.returncode}: {' / '.join(last)}. "
            "Correct that and run the suite again: it executes only missing runs."
        )


def measure(case: Case, context: SuiteContext) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Trains and evaluates: (record as in `result_file.RUN` without references, protocol, images of seed 0)."""
    folder = Path(tempfile.mkdtemp(prefix="run-", dir=context.work))
    try:
        run = folder / "run"
        data = str(context.root / case.scene)
        call(["train", data, "-m", str(run), *case.flags, *machine_flags(case, context)], folder / "output.txt")
        return recorded(case, context, run)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def recorded(case: Case, context: SuiteContext, run: Path) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Every figure of a finished run."""
    from gsopt.benchmark.suite import run_figures

    metrics, events = read_metrics(run), read_events(run / "events.jsonl")[0]
    if events[-1]["kind"] != "done":
        raise RunFailed(f"{case.id} must end with `done`, got {events[-1]['kind']!r}. Run the suite again.")
    if not metrics.get("per_view"):
        raise InputError(f"{case.scene} holds out no views, so nothing can be evaluated. Add --eval to its group.")
    finished = open_run(run, threads=context.threads)
    scene = load_scene(finished.config.data)
    started = next(event for event in events if event["kind"] == "started")
    setup = float(started.get("setup_cpu_seconds", 0.0))
    per_view = {name: [row[name] for row in metrics["per_view"]] for name in METRICS[:4]}
    per_view |= run_figures.shape(finished, scene)
    record = {
        **case.fields,
        "key": key(case, context),
        "flags": list(case.flags),
        "views_in": len(scene.train),
        "views_out": [row["name"] for row in metrics["per_view"]],
        "per_view": per_view,
        "mean": {name: mean(values) for name, values in per_view.items()},
        "curve": run_figures.curve(finished, scene, events, setup),
        "curve_views": min(run_figures.CURVE_VIEWS, len(scene.test)),
        "setup_cpu_seconds": round(setup, 2),
        "train_cpu_seconds": round(metrics["train_cpu_seconds"], 2),
        "peak_memory_mb": metrics["peak_memory_mb"],
        "n_gaussians": metrics["n_gaussians"],
        "init": metrics["init"],
        "guidance": guidance_facts(run),
        "code": run_key.code_hash(),
    }
    images: dict[str, Any] = {}
    if case.seed == 0:
        images[f"{case.scene}|{case.views}"], images[case.id] = run_figures.images(finished, scene)
    return record, metrics["protocol"], images


def mean(values: list[float | None]) -> float | None:
    """Mean over views, or None when a view lacks the value."""
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known), 6) if known and len(known) == len(values) else None


def guidance_facts(run: Path) -> dict[str, Any]:
    """The run's prior, the reason for it, and the guard's decision."""
    found = json.loads((run / "config.json").read_bytes()).get("guidance") or {}
    guard = found.get("guard") or {}
    factor = guard.get("factor")
    return {
        "prior": found.get("prior"),
        "reason": str(found.get("reason", "")),
        "factor": None if factor is None else float(factor),
        "guard": str(guard.get("reason", "")),
    }
