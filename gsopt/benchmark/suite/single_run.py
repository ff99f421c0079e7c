"""One run of a suite: a job of a farm, which trains in a process of its own and returns all figures as one record."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gsopt.benchmark.machine import machine
from gsopt.benchmark.suite import arm_flags, run_key
from gsopt.benchmark.suite.definition import EVALUATIONS, Case
from gsopt.benchmark.suite.result_file import METRICS
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.errors import GsoptError, InputError
from gsopt.events import read_events
from gsopt.farm.job import Job
from gsopt.farm.worker import Worker, serving
from gsopt.metrics import find_vgg_weights
from gsopt.raster.cpu_backend import ISA_VARIABLE, workspace
from gsopt.results.evaluation import read_metrics
from gsopt.results.finished_run import open_run
from gsopt.sds.prompts import read_set, write_prompts
from gsopt.sds.select_prior import EMBEDDED, embedded_prior_obstacle

ENVIRONMENT = {"OMP_NUM_THREADS": "1"}
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
    call([*command, "-o", str(every), "--force"])
    found = read_set(every).prompts
    write_prompts(path, [prompt for prompt in found if prompt.source.startswith(arm_flags.PROMPT_SOURCES[case.arm])])
    return path


def machine_flags(case: Case, context: SuiteContext) -> list[str]:
    """Flags that change the speed of a run and its previews, but no bit of its result."""
    flags = ["--threads", str(context.threads), "--checkpoint-every", "0"]
    flags += ["--preview-every", str(max(1, case.iterations // EVALUATIONS))]
    flags += ["--vgg"] if find_vgg_weights() is not None else []
    if arm_flags.is_guided(case.arm) and context.prior:
        flags += ["--prior", context.prior]
    path = prompts(case, context)
    return flags if path is None else [*flags, "--prompts", str(path)]


def call(arguments: list[str]) -> None:
    """`gsopt ARGUMENTS` in a process of its own; RunFailed with the end of its output."""
    job = Job("gsopt", serving("gsopt.cli.serve_jobs"), {"arguments": arguments}, environment=ENVIRONMENT)
    worker = Worker()
    try:
        outcome = worker.do(job, job.request)
    finally:
        worker.end()
    if outcome.ending != "done" or outcome.answer:
        last = " / ".join(outcome.output.splitlines()[-MAX_ERROR_LINES:])
        raise RunFailed(
            f"`gsopt {' '.join(arguments)}` ended with {outcome.error or f'exit code {outcome.answer}'}: {last}. "
            "Correct that and run the suite again: it executes only missing runs."
        )


def run_job(case: Case, context: SuiteContext, run_hash: str) -> Job:
    """The run as a job of a farm; its answer is that of `answer`."""
    flags = machine_flags(case, context)
    request = {
        "case": asdict(case),
        "key": run_hash,
        "root": str(context.root),
        "work": str(context.work),
        "threads": context.threads,
        "flags": flags,
    }
    inputs = [context.root / case.scene, *(path for word in flags if (path := Path(word)).is_absolute())]
    environment = {**ENVIRONMENT, ISA_VARIABLE: workspace(1).isa}
    command = serving("gsopt.benchmark.suite.worker")
    return Job(case.id, command, request, inputs=tuple(inputs), cpus=context.threads, environment=environment)


def answer(request: Mapping[str, Any]) -> dict[str, Any]:
    """Executes a request of `run_job`: trains, evaluates, and returns the figures with the machine they come from."""
    case = Case(**{**request["case"], "flags": tuple(request["case"]["flags"])})
    root, work = Path(request["root"]), Path(request["work"])
    torch.set_num_threads(1)
    folder = Path(tempfile.mkdtemp(prefix="run-", dir=work if work.is_dir() else None))
    try:
        run = folder / "run"
        call(["train", str(root / case.scene), "-m", str(run), *case.flags, *request["flags"]])
        record, protocol, images = recorded(case, run, request["key"], request["threads"])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return {"record": record, "protocol": protocol, "images": images, "machine": machine()}


def recorded(case: Case, run: Path, run_hash: str, threads: int) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Figures of a finished run: (record as in `result_file.RUN` without references, protocol, images of seed 0)."""
    from gsopt.benchmark.suite import run_figures

    metrics, events = read_metrics(run), read_events(run / "events.jsonl")[0]
    if events[-1]["kind"] != "done":
        raise RunFailed(f"{case.id} must end with `done`, got {events[-1]['kind']!r}. Run the suite again.")
    if not metrics.get("per_view"):
        raise InputError(f"{case.scene} holds out no views, so nothing can be evaluated. Add --eval to its group.")
    finished = open_run(run, threads=threads)
    scene = load_scene(finished.config.data)
    started = next(event for event in events if event["kind"] == "started")
    setup = float(started.get("setup_cpu_seconds", 0.0))
    per_view = {name: [row.get(name) for row in metrics["per_view"]] for name in METRICS[:4]}
    per_view |= run_figures.shape(finished, scene)
    record = {
        **case.fields,
        "key": run_hash,
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
