"""`gsopt finetune` in order: fits, training, measurement, the prior's folder. Each part continues where it was."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gsopt import check
from gsopt.config.guidance import GuidanceConfig
from gsopt.data.files import read_json
from gsopt.data.scene import is_posed
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic
from gsopt.finetune.caption_tokens import Told, tell
from gsopt.finetune.evaluation import measure, sheet
from gsopt.finetune.folder import write_folder
from gsopt.finetune.pair_cache import Library, collect
from gsopt.finetune.text_encoder import find_encoder, said_of_all, words_known
from gsopt.finetune.trainer import STATE, Training
from gsopt.finetune.training_config import Course
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Backend
from gsopt.sds.priors.view_conditioned import CARD, CLIP, ViewPrior, is_view_prior, make_deaf, make_unet, side_multiple
from gsopt.sds.select_prior import EMBEDDED

SHEET_EVERY = 500
"""Steps between two sample sheets."""
NEWS = 0.02
"""Share of a new loss in the running mean that is shown."""


@dataclass(frozen=True)
class Lessons:
    """Which scenes are learned from, and how often each is reconstructed."""

    train: tuple[Path, ...]
    val: tuple[Path, ...]
    """Held out: only measured on."""
    fits: int = 3
    size: int = 128
    """Side of the renders, px."""
    seed: int = 0

    def __post_init__(self) -> None:
        check.at_least("--fits", self.fits, 1, "3 is usual.")
        check.within("--size", self.size, 64, 512, "The default is 128.")
        if self.size % side_multiple():
            near = round(self.size / side_multiple()) * side_multiple()
            raise UsageError(f"`--size` must be a multiple of {side_multiple()}, got {self.size}. Try {near}.")


def find_scenes(roots: Sequence[Path], val: Sequence[str]) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Posed scenes among and below `roots`, by name; those called `val` apart (none given: every tenth)."""
    found: dict[str, Path] = {}
    for path in (p for root in roots for p in (root, *sorted(root.iterdir() if root.is_dir() else ())) if _is(p)):
        if found.setdefault(path.name, path) != path:
            raise UsageError(f"{found[path.name]} and {path} have the same name. Rename one, or give only one of them.")
    unknown = [name for name in val if name not in found]
    if unknown:
        raise UsageError(f"`--val` names {unknown[0]!r}, which is none of the {len(found)} scenes found. Correct it.")
    names = sorted(found)
    held = list(val) or names[9::10]
    train = tuple(found[name] for name in names if name not in held)
    if not train:
        raise InputError(
            f"No posed scene to learn from in {', '.join(map(str, roots))}. Give folders with transforms.json or "
            "COLMAP models, or a folder of such folders (scripts/synth_views.py makes them)."
        )
    return train, tuple(found[name] for name in held)


def _is(path: Path) -> bool:
    return path.is_dir() and is_posed(path)


def start(
    lessons: Lessons, course: Course, out: Path, base: str | None, threads: int, report: Report
) -> dict[str, Any]:
    """`finetune` on this machine's compiled backend; `base` as on the command line."""
    if threads:
        torch.set_num_threads(threads)
    folder = None if base is None else EMBEDDED if base == "embedded" else Path(base)
    return finetune(lessons, course, out, make_backend("auto", threads), folder, report)


def finetune(
    lessons: Lessons, course: Course, out: Path, backend: Backend, base: Path | None, report: Report
) -> dict[str, Any]:
    """Train a prior into `out` and return what was measured on the held-out scenes.

    Run again after a kill it goes on where it was. Raises InputError for scenes that cannot be read and for an `out`
    that holds something else.
    """
    _claim(out, lessons, course, base)
    train, val = (_library(scenes, lessons, out / "pairs", backend, report) for scenes in (lessons.train, lessons.val))
    assert train is not None
    held = 0 if val is None else len(val.pairs)
    report(f"{len(train.pairs)} renders of {len(lessons.train)} scenes to learn from, {held} held out")
    encoder = find_encoder(train, course, out / CLIP, base, report)
    told, told_val = (
        None if encoder is None or part is None else tell(encoder, part, said_of_all(part)) for part in (train, val)
    )
    training = Training(make_unet(course.seed) if base is None else _base(base, told is not None), course, told)
    if (out / STATE).exists():
        training.restore(out / STATE)
        report(f"continuing at step {training.step}")
    if training.step == course.steps and (out / CARD).exists():
        return dict(read_json(out / CARD).get("measured") or {})
    training.run(train.pairs, out, _Log(out, training, val, told_val, report))
    unet = training.averaged()
    measured = {} if val is None else measure(unet, val.pairs, told_val)
    if encoder is not None and val is not None:
        measured |= {"words": words_known(encoder, val)}
    write_folder(out, unet, lessons, course, base, measured)
    return measured


def _claim(out: Path, lessons: Lessons, course: Course, base: Path | None) -> None:
    """Remember what `out` is made from; InputError where it is something else."""
    path = out / "finetune.json"
    plan = {
        "course": asdict(course),
        "fits": lessons.fits,
        "size": lessons.size,
        "seed": lessons.seed,
        "train": [scene.name for scene in lessons.train],
        "val": [scene.name for scene in lessons.val],
        "base": None if base is None else base.name,
    }
    if path.exists():
        if read_json(path) != json.loads(to_json(plan)):
            raise InputError(f"{out} belongs to a training with other scenes or flags. Repeat them or give another -o.")
        return
    if out.exists() and any(entry.name != "pairs" for entry in out.iterdir()):
        raise InputError(f"{out} is not empty and holds no training of a prior. Give another -o.")
    out.mkdir(parents=True, exist_ok=True)
    write_atomic(path, to_json(plan))


def _library(
    scenes: Sequence[Path], lessons: Lessons, folder: Path, backend: Backend, report: Report
) -> Library | None:
    if not scenes:
        return None
    return collect(scenes, lessons.fits, lessons.size, lessons.seed, folder, backend, report)


def _base(folder: Path, told: bool) -> Any:
    """The network to start from; one that was never told anything goes on as it was."""
    if not is_view_prior(folder):
        raise InputError(
            f"`--base` {folder} is no view-conditioned prior. Give a folder that `gsopt finetune` wrote; "
            "to train Stable Diffusion on images, add --on-views."
        )
    unet = ViewPrior(folder, GuidanceConfig()).unet.requires_grad_(True)
    if told and not (folder / CLIP).is_dir():
        make_deaf(unet)
    return unet


class _Log:
    """Hears every step: a line now and then, train.jsonl, and sample sheets of held-out renders."""

    def __init__(self, out: Path, training: Training, val: Library | None, told: Told | None, report: Report) -> None:
        self._out, self._course, self._training, self._report = out, training.course, training, report
        self._val, self._told = val, told
        self._mean: float | None = None
        self._began, self._first = time.monotonic(), training.step

    def __call__(self, step: int, found: float) -> None:
        self._mean = found if self._mean is None else self._mean + NEWS * (found - self._mean)
        if step % 100 == 0 or step == self._course.steps:
            seconds = time.monotonic() - self._began
            left = seconds / max(1, step - self._first) * (self._course.steps - step)
            self._report(f"step {step}/{self._course.steps}  loss {self._mean:.5f}  ETA {left / 60:.0f} min")
            with (self._out / "train.jsonl").open("a", encoding="utf-8") as log:
                log.write(json.dumps({"step": step, "loss": self._mean, "seconds": round(seconds, 1)}) + "\n")
        if self._val is not None and step % SHEET_EVERY == 0:
            self._show(step)

    def _show(self, step: int) -> None:
        unet = self._training.averaged()
        folder = self._out / "samples"
        folder.mkdir(exist_ok=True)
        assert self._val is not None
        with torch.no_grad():
            sheet(unet, self._val.pairs, self._told).save(folder / f"step_{step:06d}.png")
        self._training.back()
