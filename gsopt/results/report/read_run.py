"""Reads the content of a report from a run directory that is not trusted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene, View, load_scene
from gsopt.errors import GsoptError
from gsopt.events import LARGEST_METRICS, read_events
from gsopt.geometry.cameras import Cameras
from gsopt.results.evaluation import METRICS, evenly_spread
from gsopt.results.finished_run import FinishedRun, camera_path, open_run, truth, with_longest_side
from gsopt.results.report.cameras_section import cameras_section
from gsopt.results.report.embedded_images import shrunk
from gsopt.results.report.guidance_section import guidance_section
from gsopt.results.report.library_section import library_section
from gsopt.results.report.shape_prior_section import shape_prior_section
from gsopt.results.report.values import number, text
from gsopt.results.video import as_image
from gsopt.results.web.page import viewer_element
from gsopt.results.web.payload import packed_splats
from gsopt.results.web.scene import scene_of_views

MAX_EVALUATED_VIEWS = 12
EXTREME_VIEWS = 4
MAX_INPUT_VIEWS = 24
TURNTABLE_FRAMES = 36
MAX_VIEWER = 6 << 20
"""Bytes of packed splats in a report, some 300,000 splats; larger runs show a turntable."""
TURNTABLE_SIDE = 400


@dataclass(frozen=True)
class EvaluatedView:
    """One evaluated view."""

    name: str
    badge: str
    """`worst`, `best` or empty."""
    figures: dict[str, float | None]
    render: Image.Image
    truth: Image.Image


@dataclass(frozen=True)
class Progress:
    """One `progress` event."""

    step: float
    seconds: float | None
    loss: float | None
    psnr: float | None
    n: float | None


@dataclass
class Report:
    """Content of the page. Strings are unescaped: the page escapes them."""

    name: str
    config: TrainConfig
    recorded: dict[str, Any]
    """config.json as a whole."""
    metrics: dict[str, Any]
    progress: list[Progress]
    messages: list[str]
    """Warnings and errors of the run, then missing parts of the report."""
    held_out: bool = True
    """True when the evaluated views were held out from training."""
    mean: dict[str, float | None] = field(default_factory=dict)
    per_view: list[dict[str, Any]] = field(default_factory=list)
    evaluated: list[EvaluatedView] = field(default_factory=list)
    inputs: list[tuple[str, Image.Image]] = field(default_factory=list)
    input_count: int | None = None
    test_count: int | None = None
    n_gaussians: int | None = None
    steps: int | None = None
    backend: str | None = None
    viewer: str = ""
    """Finished HTML: the splats to turn with the mouse; empty when they are too many for a report."""
    turntable: list[Image.Image] = field(default_factory=list)
    """Replaces the viewer."""
    guidance: str = ""
    """Finished HTML."""
    library: str = ""
    """Finished HTML."""
    cameras: str = ""
    """Finished HTML."""


@torch.no_grad()
def read_run(run: Path, config: TrainConfig) -> Report:
    """Reads and renders every part of the report; a missing part leaves a message instead."""
    messages: list[str] = []
    events = _events(run, messages)
    report = Report(
        name=Path(config.data.path).name or "run",
        config=config,
        recorded=_read_object(run / "config.json", messages),
        metrics=_read_object(run / "metrics.json", messages),
        progress=progress_of(events),
        messages=messages,
    )
    messages += [message for event in events if (message := _message(event)) is not None]
    report.guidance = guidance_section(run, messages)
    report.library = library_section(run, messages) + shape_prior_section(run, messages)
    report.cameras = cameras_section(Path(config.data.path), run, messages)
    _add_figures(report)
    try:
        scene = load_scene(config.data)
        _add_inputs(report, scene)
        finished = open_run(run)
        _add_renders(report, finished, scene)
    except GsoptError as error:
        messages.append(f"Some images are missing from this report. {error}")
    return report


def progress_of(events: Sequence[dict[str, Any]]) -> list[Progress]:
    """Progress of a run, without the steps that a resumed run repeated from a checkpoint."""
    progress_charts: list[Progress] = []
    for event in events:
        step = number(event.get("step"))
        if event.get("kind") != "progress" or step is None or step < 0:
            continue
        while progress_charts and progress_charts[-1].step >= step:
            progress_charts.pop()
        seconds, loss, psnr, n = (number(event.get(key)) for key in ("seconds", "loss", "psnr", "n"))
        progress_charts.append(Progress(step, seconds, loss, psnr, n))
    return progress_charts


def representative_rows(psnrs: Sequence[float]) -> list[int]:
    """Rows to show, from worst to best: the extremes at both ends and an even selection between them."""
    order = sorted(range(len(psnrs)), key=lambda row: psnrs[row])
    if len(order) <= MAX_EVALUATED_VIEWS:
        return order
    between = order[EXTREME_VIEWS:-EXTREME_VIEWS]
    count = MAX_EVALUATED_VIEWS - 2 * EXTREME_VIEWS
    spread = [between[(2 * i + 1) * len(between) // (2 * count)] for i in range(count)]
    return order[:EXTREME_VIEWS] + spread + order[-EXTREME_VIEWS:]


def _events(run: Path, messages: list[str]) -> list[dict[str, Any]]:
    try:
        return read_events(run / "events.jsonl")[0]
    except (GsoptError, OSError) as error:
        messages.append(f"The training progress is missing from this report. {error}")
        return []


def _message(event: dict[str, Any]) -> str | None:
    if event.get("kind") not in ("warning", "error"):
        return None
    prefix = "The run ended with an error: " if event["kind"] == "error" else ""
    return prefix + text(event.get("message", ""))


def _read_object(path: Path, messages: list[str]) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        with open(path, "rb") as file:
            document = json.loads(file.read(LARGEST_METRICS))
    except (OSError, ValueError, RecursionError) as error:
        messages.append(f"{path.name} cannot be read: {error}.")
        return {}
    return document if isinstance(document, dict) else {}


def _add_figures(report: Report) -> None:
    """Adds means and rows of the held-out views or, without any, of the training views, marked as such."""
    source = report.metrics
    if not isinstance(source.get("mean"), dict) and isinstance(source.get("train"), dict):
        source, report.held_out = source["train"], False
    mean, rows = source.get("mean"), source.get("per_view")
    report.mean = {key: number(mean.get(key)) for key in METRICS} if isinstance(mean, dict) else {}
    report.per_view = [
        {"name": text(row.get("name")), **{key: number(row.get(key)) for key in METRICS}}
        for row in (rows if isinstance(rows, list) else [])
        if isinstance(row, dict)
    ]
    count = number(report.metrics.get("n_gaussians"))
    report.n_gaussians = None if count is None else int(count)
    steps = number(report.metrics.get("steps"))
    report.steps = None if steps is None else int(steps)


def _add_inputs(report: Report, scene: Scene) -> None:
    background = torch.ones(3)
    views = evenly_spread(scene.train, MAX_INPUT_VIEWS)
    report.inputs = [(view.name, shrunk(as_image(truth(view, background)), 200)) for view in views]
    report.input_count, report.test_count = len(scene.train), len(scene.test)


def _add_renders(report: Report, finished: FinishedRun, scene: Scene) -> None:
    report.n_gaussians, report.backend = len(finished.gaussians), finished.backend.name
    views = {view.name: view for view in (scene.test if report.held_out else scene.train)}
    rows = [row for row in report.per_view if row["name"] in views and row["psnr"] is not None]
    order = representative_rows([row["psnr"] for row in rows])
    for place, index in enumerate(order):
        badge = {0: "worst", len(order) - 1: "best"}.get(place, "") if len(order) > 1 else ""
        report.evaluated.append(_evaluated_view(finished, views[rows[index]["name"]], rows[index], badge))
    report.viewer = _viewer(finished, scene)
    if not report.viewer:
        _add_turntable(report, finished, scene)


def _viewer(finished: FinishedRun, scene: Scene) -> str:
    payload = packed_splats(finished.gaussians, finished.path / "splat.ply")
    if len(payload.data) > MAX_VIEWER:
        return ""
    return viewer_element(scene_of_views(finished, scene), payload, opened=False)


def _add_turntable(report: Report, finished: FinishedRun, scene: Scene) -> None:
    size = scene.train[0].camera
    cameras = Cameras.of_one_size([view.camera for view in scene.train])
    path_cameras = camera_path(finished, cameras, "turntable", TURNTABLE_FRAMES)
    side = min(TURNTABLE_SIDE, 2 * max(size.width, size.height))
    report.turntable = [
        as_image(finished.draw(with_longest_side(path_cameras[i], side))) for i in range(len(path_cameras))
    ]


def _evaluated_view(finished: FinishedRun, view: View, row: dict[str, Any], badge: str) -> EvaluatedView:
    render, target = as_image(finished.draw(view.camera)), as_image(truth(view, finished.background))
    return EvaluatedView(view.name, badge, {key: row[key] for key in METRICS}, render, target)
