"""The result file of a suite: all figures of every run, written whole after each, and the images beside it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gsopt.benchmark import schema
from gsopt.benchmark.suite.definition import BUILT_IN_SUITES, Suite
from gsopt.data.files import read_json
from gsopt.errors import InputError, UsageError
from gsopt.events import write_atomic

VERSION = 1
METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "mask_iou", "depth_error")
"""Per view; the last two only where the scene has the truth for them."""
NUMBERS = [(float, None)]
MACHINE = {key: kind for key, kind in schema.MACHINE.items() if key != "load"}
CURVE_POINT = {"step": int, "cpu_seconds": float, "gaussians": int, "psnr": float, "lpips_alex": (float, None)}
"""Held-out quality at one step; seconds count reading, first Gaussians and the guard, not the interpreter's start."""
CASE = {"group": str, "scene": str, "views": str, "arm": str, "iterations": int, "seed": int}
RUN = CASE | {
    "key": str,
    "flags": [str],
    "views_in": int,
    "views_out": [str],
    "per_view": {name: NUMBERS for name in METRICS},
    "mean": {name: (float, None) for name in METRICS},
    "curve": [CURVE_POINT],
    "curve_views": int,
    "setup_cpu_seconds": float,
    "train_cpu_seconds": float,
    "peak_memory_mb": (float, None),
    "n_gaussians": int,
    "init": str,
    "guidance": {"prior": (str, None), "reason": str, "factor": (float, None), "guard": str},
    "protocol": int,
    "machine": int,
    "code": str,
    "load": (float, None),
}
SKIPPED = CASE | {"reason": str}
DOCUMENT = {
    "version": int,
    "suite": str,
    "command": str,
    "machines": [MACHINE],
    "protocols": [str],
    "runs": [RUN],
    "skipped": [SKIPPED],
}
Document = dict[str, Any]


def run_id(record: dict[str, Any]) -> str:
    """Equals `definition.Case.id`."""
    return "|".join(str(record[name]) for name in CASE)


def shape(document: Document) -> schema.Schema:
    """The schema of a result file; one of a suite of one's own repeats its declaration."""
    return DOCUMENT | ({"declaration": str} if "declaration" in document else {})


def empty(suite: str, command: str) -> Document:
    lists: Document = {"machines": [], "protocols": [], "runs": [], "skipped": []}
    return {"version": VERSION, "suite": suite, "command": command, **lists}


def read(path: Path) -> dict[str, Any]:
    """InputError for a file that is broken or holds something else."""
    document = read_json(path)
    if document.get("suite") not in BUILT_IN_SUITES and "declaration" not in document:
        got = str(document.get("suite"))[:40]
        raise InputError(f"{path} must hold results of a suite, got suite {got!r}. Name another file with -o.")
    schema.require(document, shape(document), path.name)
    return document


def opened(path: Path, suite: Suite, command: str) -> Document:
    """The results so far, or an empty document for a new file; UsageError when the file belongs to another suite."""
    document = read(path) if path.exists() else empty(suite.name, command)
    if document["suite"] != suite.name:
        raise UsageError(
            f"`-o {path}` holds results of the suite {document['suite']}, got --suite {suite.name}. Name another file."
        )
    own = {} if suite.declaration is None else {"declaration": suite.declaration}
    return {**document, "command": command, **own}


def write(path: Path, document: dict[str, Any]) -> None:
    """Writes the whole file or nothing, one run per line; refuses what departs from the schema."""
    schema.require(document, shape(document))
    write_atomic(path, compact(document))


def compact(document: dict[str, Any]) -> bytes:
    """Strict JSON with one line per record of a list."""
    parts = []
    for name, value in document.items():
        if isinstance(value, list) and value:
            body = "[\n" + ",\n".join(dumps(item) for item in value) + "\n]"
        else:
            body = dumps(value)
        parts.append(f"{dumps(name)}:{body}")
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


def dumps(value: Any) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))


def with_run(document: Document, record: Document, machine: Document, protocol: str) -> Document:
    """The document with this run in place of an older one of the same case."""
    machines, protocols = document["machines"], document["protocols"]
    bare = {key: value for key, value in machine.items() if key != "load"}
    machines = machines if bare in machines else [*machines, bare]
    protocols = protocols if protocol in protocols else [*protocols, protocol]
    record = {
        **record,
        "machine": machines.index(bare),
        "protocol": protocols.index(protocol),
        "load": machine["load"],
    }
    return {
        **document,
        "machines": machines,
        "protocols": protocols,
        "runs": [run for run in document["runs"] if run_id(run) != run_id(record)] + [record],
        "skipped": [skip for skip in document["skipped"] if run_id(skip) != run_id(record)],
    }


def with_skip(document: Document, record: Document) -> Document:
    """The document with this run among the skipped ones, with its reason."""
    kept = [skip for skip in document["skipped"] if run_id(skip) != run_id(record)]
    return {**document, "skipped": [*kept, record]}


def images_path(path: Path) -> Path:
    """Path of the images of a result file."""
    return path.with_name(f"{path.stem}-pictures.json")


def read_images(path: Path) -> dict[str, Any]:
    """Data URIs by case and by scene; {} when there is no file."""
    return read_json(images_path(path)) if images_path(path).exists() else {}


def write_images(path: Path, images: dict[str, Any]) -> None:
    write_atomic(images_path(path), compact(images))


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Allows one writer per result file until the process ends. Has no effect on Windows."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(path.with_name(f".{path.name}.lock"), "w", encoding="ascii") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            message = f"`-o {path}` must have one writer, got a second. Wait for the other, or name another file."
            raise UsageError(message) from error
        yield
