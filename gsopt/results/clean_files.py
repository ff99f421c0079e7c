"""`gsopt clean`: the files of a run before and after, a picture of the difference, and the way back."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from PIL import Image
from torch import Tensor

from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import View, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import write_atomic
from gsopt.formats import is_antialiased, save_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.camera_paths import turntable_path
from gsopt.geometry.cameras import Cameras
from gsopt.results.clean import MAX_COST, Finding, findings, kept, left_out_change
from gsopt.results.evaluation import evaluate, read_metrics
from gsopt.results.finished_run import FinishedRun, draw, look_at_point, open_run, with_longest_side
from gsopt.results.report import write_report
from gsopt.results.video import as_image

SPLATS, BEFORE, PICTURE = "splat.ply", "splat.before-clean.ply", "clean.png"
METRICS, METRICS_BEFORE = "metrics.json", "metrics.before-clean.json"
REPORT = "report.html"
SIDE, GAP, ROWS = 360, 8, 3


@dataclass(frozen=True)
class Cleaning:
    """The findings of `clean`, and the splats that stay."""

    findings: list[Finding]
    gaussians: Gaussians
    left_out: int
    """Splats that go."""


def clean(run: Path | str | FinishedRun, *, box: tuple[float, ...] | None = None, dry_run: bool = False) -> Cleaning:
    """Leave out the splats of a finished run that no input view needs; its first splat.ply is kept beside it.

    `box`: x y z X Y Z, scene units; what lies outside goes too. `dry_run`: nothing is written.
    """
    opened = run if isinstance(run, FinishedRun) else open_run(Path(run))
    found = findings(opened, input_views(opened), box)
    keep = kept(found, len(opened.gaussians))
    if not dry_run and not bool(keep.all()):
        replace_splats(opened, keep)
    return Cleaning(found, opened.gaussians.select(keep), int((~keep).sum()))


def clean_where_it_helps(run: Path) -> tuple[Cleaning | None, float]:
    """Clean a run that was not evaluated yet, unless views without a part in the decision lose more than MAX_COST:
    what was done, or None, and the change in those views, dB."""
    opened = open_run(run)
    change = left_out_change(opened, input_views(opened))
    return (clean(opened) if change >= -MAX_COST else None), change


def input_views(run: FinishedRun) -> tuple[View, ...]:
    """The input views of a run, with refined poses where it has them."""
    return with_refined_poses(load_scene(run.config.data), run.path).train


def replace_splats(run: FinishedRun, keep: Bool[Tensor, "N"]) -> None:
    """Write splat.ply without the other splats; the first one stays as splat.before-clean.ply."""
    splats, before = run.path / SPLATS, run.path / BEFORE
    antialiased = is_antialiased(splats)
    if before.is_symlink():
        raise InputError(f"{before} must not be a symbolic link, got one. Remove it.")
    if not before.exists():
        os.link(splats, before)
    save_splats(splats, run.gaussians.select(keep), antialiased=antialiased)
    measure_again(run.path)


def measure_again(run: Path) -> None:
    """Write metrics.json and the report of an evaluated run anew; the first are kept as metrics.before-clean.json."""
    metrics, before = run / METRICS, run / METRICS_BEFORE
    if metrics.is_file() and not before.exists():
        os.link(metrics, before)
    evaluate_again(run)


def evaluate_again(run: Path) -> None:
    """Write metrics.json and the report anew where a run has them."""
    if not (run / METRICS).is_file():
        return
    mean = read_metrics(run).get("mean")
    evaluate(run, vgg=isinstance(mean, dict) and mean.get("lpips_vgg") is not None)
    if (run / REPORT).is_file():
        write_report(run)


def undo(run: Path) -> None:
    """Bring splat.before-clean.ply back as splat.ply, and the figures that belong to it.

    A run that was cleaned before its evaluation is evaluated again.
    """
    before = run / BEFORE
    if before.is_symlink() or not before.is_file():
        raise UsageError(f"{run} was not cleaned: there is no {BEFORE}. Nothing was changed.")
    os.replace(before, run / SPLATS)
    if (run / METRICS_BEFORE).is_file():
        os.replace(run / METRICS_BEFORE, run / METRICS)
        if (run / REPORT).is_file():
            write_report(run)
    else:
        evaluate_again(run)


def write_picture(run: FinishedRun, keep: Bool[Tensor, "N"], views: tuple[View, ...]) -> None:
    """Write clean.png into the run; a link in its place is replaced, not followed."""
    buffer = io.BytesIO()
    picture(run, keep, views).save(buffer, "PNG")
    write_atomic(run.path / PICTURE, buffer.getvalue())


def picture(run: FinishedRun, keep: Bool[Tensor, "N"], views: tuple[View, ...]) -> Image.Image:
    """Before, after and what goes in red, from the first input camera and two places of the turntable."""
    cameras = Cameras.of_one_size([view.camera for view in views])
    path = turntable_path(cameras, ROWS, look_at_point(run.gaussians, cameras))
    shots = [views[0].camera, *(path[i] for i in range(1, ROWS))]
    columns = [run.gaussians, run.gaussians.select(keep), marked(run.gaussians.select(~keep))]
    panes = [
        [
            as_image(draw(splats, with_longest_side(shot, SIDE), run.backend, run.settings, run.background))
            for splats in columns
        ]
        for shot in shots
    ]
    width, height = panes[0][0].size
    sheet = Image.new("RGB", (3 * (width + GAP) - GAP, ROWS * (height + GAP) - GAP), "white")
    for y, row in enumerate(panes):
        for x, pane in enumerate(row):
            sheet.paste(pane, (x * (width + GAP), y * (height + GAP)))
    return sheet


def marked(gaussians: Gaussians) -> Gaussians:
    """The splats in opaque red, from every side."""
    red = sh.sh0_from_rgb(torch.tensor([0.85, 0.1, 0.1])).expand(len(gaussians), 1, 3)
    opaque = torch.full_like(gaussians.logit_opacities, 4.0)
    return replace(gaussians, sh0=red.contiguous(), shN=torch.zeros_like(gaussians.shN), logit_opacities=opaque)
