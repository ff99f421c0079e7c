"""Reads the results of finished programs into the scene's properties."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy

from .core import dataset, interpreter, job, prompts
from .core.errors import GsoptError
from .preferences import DEFAULTS, preferences


def finish_dataset(scene: Any, work: job.Job) -> None:
    data = dataset.finished(Path(work.product))
    if data is None:
        raise GsoptError(dataset.failure(Path(work.product)) or job.complaint(work))
    scene.gsopt.dataset, scene.gsopt.source = str(data), "DATASET"


def finish_poses(scene: Any, work: job.Job) -> None:
    if not (Path(work.product) / "transforms.json").is_file():
        raise GsoptError(job.complaint(work))
    scene.gsopt.dataset, scene.gsopt.source = work.product, "DATASET"


def finish_masks(scene: Any, work: job.Job) -> None:
    if not (Path(work.product) / "masks.json").is_file():
        raise GsoptError(job.complaint(work))


def finish_prompts(scene: Any, work: job.Job) -> None:
    if not Path(work.product).is_file():
        raise GsoptError(job.complaint(work))
    found = prompts.read_prompts(Path(work.product))
    about = {key: found.rest[key] for key in ("notes", "object", "domain") if key in found.rest}
    scene.gsopt.prompts_rest = json.dumps({**prompts.parse_rest(scene.gsopt.prompts_rest), **about})
    scene.gsopt.proposals.clear()
    for prompt in found.prompts:
        fill_prompt(scene.gsopt.proposals.add(), prompt)


def finish_doctor(scene: Any, work: job.Job) -> None:
    output = job.tail(Path(work.folder) / job.OUTPUT)
    try:
        scene.gsopt.doctor = interpreter.read_answer(output, work.arguments[0]).line
    except GsoptError as error:
        scene.gsopt.doctor = str(error)
        raise


def finish_install(scene: Any, work: job.Job) -> None:
    """The interpreter of the new environment becomes that of the preferences."""
    python = Path(work.product)
    if job.exit_code(work) not in (0, None) or not (python.parent / interpreter.console_script()).is_file():
        raise GsoptError(job.complaint(work))
    machine = preferences(bpy.context)
    if machine is not DEFAULTS:
        machine.interpreter = str(python)
        bpy.context.preferences.is_dirty = True
    scene.gsopt.doctor = f"gsopt is installed: {python}"


def finish_page(scene: Any, work: job.Job) -> None:
    page = Path(work.product)
    if not page.is_file() or page.stat().st_mtime < work.started - 1:
        raise GsoptError(job.complaint(work))
    if not bpy.app.background:
        bpy.ops.wm.url_open(url=page.as_uri())


def finish_clean(scene: Any, work: job.Job) -> None:
    picture = Path(work.product)
    if not picture.is_file() or picture.stat().st_mtime < work.started - 1:
        raise GsoptError(job.complaint(work))
    scene.gsopt.message = job.tail(Path(work.folder) / job.OUTPUT).strip()[-300:]


FINISH: dict[str, Callable[[Any, job.Job], None]] = {
    "dataset": finish_dataset,
    "poses": finish_poses,
    "masks": finish_masks,
    "prompts": finish_prompts,
    "doctor": finish_doctor,
    "install": finish_install,
    "page": finish_page,
    "clean": finish_clean,
}


def fill_prompt(entry: Any, prompt: prompts.Prompt) -> None:
    """Copy a prompt of a file into an entry of the panel."""
    for name in ("text", "weight", "view", "polarity", "source", "rationale"):
        setattr(entry, name, getattr(prompt, name))
    entry.score = -2.0 if prompt.score is None else prompt.score


def prompt_of(entry: Any) -> prompts.Prompt:
    """Returns the prompt of an entry of the panel. InputError for an entry that is no prompt."""
    names = ("text", "weight", "view", "polarity", "source", "rationale")
    values = {name: getattr(entry, name) for name in names}
    values["weight"] = round(values["weight"], 6)
    return prompts.Prompt(**values, score=None if entry.score < -1 else round(entry.score, 6))
