"""Quality over time of whole runs: a curve for every preset, and a grid of budgets and lengths."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.presets import with_preset
from gsopt.config.train import DataConfig, DensityConfig, TrainConfig
from gsopt.data.scene import View
from gsopt.errors import UsageError
from gsopt.events import read_events
from gsopt.formats import load_splats
from gsopt.results.evaluation import evaluate_views, evenly_spread
from gsopt.results.finished_run import FinishedRun, open_run
from gsopt.training.loop import train

EVALUATIONS = 8
"""Evaluations during the run of a preset."""
MAX_EVALUATED_VIEWS = 16
"""Held-out views that are evaluated, evenly spread."""

Event = Mapping[str, Any]


@dataclass(frozen=True)
class Task:
    """One run of a scene."""

    scene: str
    """Its name in the tables."""
    data: DataConfig
    preset: str = "default"
    iterations: int | None = None
    """Number of steps; the preset's when None."""
    max_gaussians: int | None = None

    @property
    def kind(self) -> str:
        """A curve over the run of a preset, or one point of the grid."""
        return "curve" if self.iterations is None and self.max_gaussians is None else "grid"

    def config(self) -> TrainConfig:
        """One thread, no guidance; runs of the grid are evaluated only at their end."""
        config = with_preset(
            TrainConfig(data=self.data, guidance=GuidanceConfig(lambda_sds=0.0), threads=1), self.preset
        )
        if self.iterations is not None:
            config = config.with_steps(self.iterations)
        every = max(1, config.iterations // EVALUATIONS) if self.kind == "curve" else 0
        density = DensityConfig(max_gaussians=self.max_gaussians)
        return replace(config, density=density, preview_every=every, checkpoint_every=0)

    def key(self) -> tuple[Any, ...]:
        """Key that is equal for records of the same run."""
        config = self.config()
        return self.scene, self.kind, self.preset, config.iterations, self.max_gaussians


def measure(task: Task) -> dict[str, Any]:
    """Trains and evaluates (`schema.RUN`); CPU time counts the steps alone, without reading and evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        result = train(task.config(), Path(folder) / "run")
        if not result.scene.test:
            raise UsageError(f"{task.data.path} holds out no views, so nothing can be evaluated. Add --eval.")
        views = evenly_spread(result.scene.test, MAX_EVALUATED_VIEWS)
        points = quality_over_time(open_run(result.run), views, read_events(result.run / "events.jsonl")[0])
    points[-1] |= {"cpu_seconds": round(result.cpu_seconds, 3), "wall_seconds": round(result.train_seconds, 3)}
    return {
        "scene": task.scene,
        "kind": task.kind,
        "preset": task.preset,
        "iterations": task.config().iterations,
        "max_gaussians": task.max_gaussians,
        "points": points,
    }


@torch.no_grad()
def quality_over_time(run: FinishedRun, views: Sequence[View], events: Sequence[Event]) -> list[dict[str, Any]]:
    """Held-out quality (`schema.QUALITY`) at every preview and at the end of a run."""
    last = int(events[-1]["step"])
    files = {event["step"]: event["path"] for event in events if event["kind"] == "preview" and event["step"] < last}
    points = []
    for step, name in {**files, last: "splat.ply"}.items():
        gaussians = load_splats(run.path / name)
        found = evaluate_views(gaussians, views, run.backend, run.settings, run.background, None, vgg=False)["mean"]
        mean = {name: found[name] for name in ("psnr", "ssim", "lpips_alex")}
        cpu, wall = time_at(step, events)
        times = {"cpu_seconds": round(cpu, 3), "wall_seconds": round(wall, 3)}
        points.append({"step": step, **times, "gaussians": len(gaussians), **mean})
    return points


def time_at(step: int, events: Sequence[Event]) -> tuple[float, float]:
    """CPU and wall seconds at the end of a step, interpolated between the progress events around it."""
    known = [(0, 0.0, 0.0), *((e["step"], e["cpu_seconds"], e["seconds"]) for e in events if e["kind"] == "progress")]
    for before, after in itertools.pairwise(known):
        if before[0] <= step <= after[0] > before[0]:
            share = (step - before[0]) / (after[0] - before[0])
            return before[1] + share * (after[1] - before[1]), before[2] + share * (after[2] - before[2])
    return known[-1][1:]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The Pareto front of (cost, quality): the points that no other point beats in both, by rising cost."""
    best, kept = float("-inf"), []
    for cost, quality in sorted(points, key=lambda point: (point[0], -point[1])):
        if quality > best:
            best = quality
            kept.append((cost, quality))
    return kept
