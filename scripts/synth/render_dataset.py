"""A whole run: many objects into one folder, resumable, with dataset.json and failures.json."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gsopt.errors import InputError
from gsopt.events import TEMPORARY, write_atomic
from gsopt.events import sweep as sweep_files
from gsopt.farm.job import PARTIAL, Farm, Outcome
from gsopt.farm.local import LocalFarm
from synth.cameras import shots
from synth.export import json_text
from synth.mesh_items import Item
from synth.render_object import RECORD
from synth.settings import Settings
from synth.worker_pool import reason, render_job

VERSION = 1
DATASET, FAILURES, TIMINGS, LOG = "dataset.json", "failures.json", "timings.json", "log.txt"
FAILED = 3
"""Exit code of a run in which an object failed."""


def run(
    items: Sequence[Item],
    settings: Settings,
    seed: int,
    out: Path,
    farm: Farm | None = None,
    resume: bool = False,
    time_limit: float = 3600.0,
    memory_limit: int | None = None,
) -> int:
    """Render every item into `out / item.id` and return the exit code: 0, or 3 when any failed.

    The files do not depend on `farm`; without one, a single worker renders. `memory_limit`: bytes of a worker. With
    `resume`, objects that `out` already holds of the same run are kept. InputError when `out` holds anything else, or
    when a file that the settings name cannot be read; nothing in `out` is touched then.
    """
    began = time.perf_counter()
    header = {"version": VERSION, "settings": settings.record(), "seed": seed, "files_sha256": files_used(settings)}
    open_folder(out, header, resume)
    todo = [item for item in items if not (out / item.id / RECORD).is_file()]
    failures = [lost for item in items if item not in todo for lost in changed(out, item)]
    farm = farm or LocalFarm(max(1, settings.threads))
    report(f"{len(items)} objects, {len(items) - len(todo)} of them rendered before; {farm}")
    jobs = [
        render_job(item, settings, object_seed(seed, item.id), out / item.id, time_limit, memory_limit) for item in todo
    ]
    outcomes: list[Outcome] = []
    try:
        with (out / LOG).open("ab") as log:
            for outcome in farm.run(jobs):
                outcomes.append(outcome)
                log.write(outcome.output.encode("utf-8", "replace"))
                report(f"[{len(outcomes)}/{len(jobs)}] {line_about(outcome)}")
    finally:
        known = {item.id: item for item in todo}
        failures += [failure(known[o.job.name], reason(o)) for o in outcomes if o.ending != "done"]
        write_record(out / FAILURES, sorted(failures, key=lambda f: str(f["id"])))
        write_record(out / DATASET, header | {"objects": sorted(records(out), key=lambda r: str(r["id"]))})
        write_record(out / TIMINGS, timings(outcomes, time.perf_counter() - began))
    report(f"{len(items) - len(failures)} of {len(items)} objects are in {out}")
    for lost in failures:
        report(f"failed: {lost['id']}: {lost['reason']}")
    return FAILED if failures else 0


def files_used(settings: Settings) -> dict[str, str]:
    """Checksums of the files that every object needs, by flag. InputError when one of them cannot be used."""
    if settings.layout == "file":
        shots(settings, 0)
    named = {"--cameras": settings.camera_file, "--lighting hdri": settings.hdri}
    found = {}
    for flag, name in named.items():
        try:
            if name is not None:
                found[flag] = hashlib.sha256(Path(name).read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"`{flag}` cannot read {name}: {error.strerror}. Check path and permissions.") from None
    return found


def report(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def open_folder(out: Path, header: dict[str, Any], resume: bool) -> None:
    """Make `out`, or make sure that it belongs to this run; then remove what a killed run left half written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        occupied = any(not TEMPORARY.fullmatch(path.name) for path in out.iterdir())  # of a run killed at its start
        if occupied:
            check_same_run(out, header, resume)
        sweep(out)
        if not occupied:
            write_record(out / DATASET, header | {"objects": []})
    except OSError as error:
        raise InputError(f"Cannot use the output folder {out}: {error.strerror}. Choose another -o.") from None


def sweep(out: Path, tries: int = 20) -> None:
    """Remove half-written files and folders. A worker whose run was just killed may still write: then once more."""
    sweep_files(out)
    for partial in list(out.rglob(PARTIAL + "*")):
        for _ in range(tries):
            shutil.rmtree(partial, ignore_errors=True)
            if not partial.exists():
                break
            time.sleep(0.2)


def check_same_run(out: Path, header: dict[str, Any], resume: bool) -> None:
    """InputError unless `out` was begun with the same settings and seed and `resume` says to go on."""
    try:
        before = json.loads((out / DATASET).read_text(encoding="utf-8"))
        kept = {"seed": before["seed"], **before["settings"], **before.get("files_sha256", {})}
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{out} is not empty and holds no run of synth_views. Choose another -o.") from None
    asked = json.loads(json.dumps({"seed": header["seed"], **header["settings"], **header["files_sha256"]}))
    differing = [f"{k} {kept.get(k)!r}, now {v!r}" for k, v in asked.items() if kept.get(k) != v]
    if before.get("version") != header["version"] or differing:
        raise InputError(f"{out} holds a run with other settings ({'; '.join(differing)}). Choose another -o.")
    if not resume:
        raise InputError(f"{out} holds a run already. Add --resume to go on with it, or choose another -o.")


def object_seed(seed: int, item_id: str) -> int:
    """A seed of its own for every object, whichever others are rendered."""
    return int.from_bytes(hashlib.sha256(f"{seed} {item_id}".encode()).digest()[:4]) >> 1


def changed(out: Path, item: Item) -> list[dict[str, str | None]]:
    """A failure when the mesh is no longer what was rendered: neither is touched."""
    kept = json.loads((out / item.id / RECORD).read_text(encoding="utf-8"))
    try:
        same = hashlib.sha256(item.mesh.read_bytes()).hexdigest() == kept["mesh_sha256"]
    except OSError:
        return []  # the mesh is gone, its views are here
    remedy = f"Remove {out / item.id} to render it again."
    return [] if same else [failure(item, f"The mesh has changed since it was rendered. {remedy}")]


def failure(item: Item, reason: str | None) -> dict[str, str | None]:
    return {"id": item.id, "mesh": str(item.mesh), "reason": reason}


def records(out: Path) -> Iterator[dict[str, Any]]:
    """The record of every finished object below `out`."""
    for folder, below, files in os.walk(out):
        if RECORD in files:
            below.clear()
            path = Path(folder) / RECORD
            yield {"folder": path.parent.relative_to(out).as_posix()} | json.loads(path.read_text(encoding="utf-8"))
        below[:] = sorted(name for name in below if not name.startswith("."))


def timings(outcomes: Sequence[Outcome], seconds: float) -> dict[str, Any]:
    """Returns the times of this invocation; dataset.json has none, so that equal runs write equal files."""
    done = {o.job.name: o.answer for o in outcomes if o.ending == "done"}
    total = {stage: sum(s[stage] for s in done.values()) for stage in ("stage", "render", "write")}
    return {"wall_seconds": seconds, "objects": len(done), "seconds_in_workers": total, "by_object": done}


def line_about(outcome: Outcome) -> str:
    if outcome.ending != "done" or outcome.job.folder is None:
        return f"{outcome.job.name}: {reason(outcome)}"
    record = json.loads((outcome.job.folder / RECORD).read_text(encoding="utf-8"))
    warnings = "".join(f"; {warning}" for warning in record.get("warnings", []))
    return f"{outcome.job.name}: {sum(outcome.answer.values()):.1f} s{warnings}"


def write_record(path: Path, content: Any) -> None:
    """Write a whole file of the run, or leave the old one and raise InputError."""
    write_atomic(path, json_text(content).encode())
