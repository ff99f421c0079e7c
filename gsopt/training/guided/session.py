"""`RunGuidance`: guidance at work in a run, and the pictures it leaves for the report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gsopt.events import to_json, write_atomic
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.results.finished_run import to_bytes
from gsopt.results.video import save_stills
from gsopt.sds.guidance_memory import CoverageRecord
from gsopt.sds.guidance_step import Guidance, StepRecord

REPORT_VIEWS = 3
MAX_VIEW_COSINE = 0.7
"""Two viewing directions are both in the report when their cosine is below this."""
REPORT_STEPS = 4


def add_gradients(gradients: Gradients, more: Gradients) -> None:
    """Add what moves the parameters, in place. `means2d` stays: density control must not see guidance."""
    for name in PARAMETERS:
        getattr(gradients, name).add_(getattr(more, name))


class RunGuidance:
    """Adds the gradients of guidance to those of a run and keeps pictures of it."""

    def __init__(self, guidance: Guidance, folder: Path | None = None, facts: dict[str, Any] | None = None) -> None:
        """`folder` None: a short run that leaves nothing behind. `facts`: further entries of the summary."""
        self.guidance = guidance
        self._folder, self._facts = folder, facts or {}
        self._planned = guidance.plan.guided_steps
        self._views: list[int] = []
        self._samples: list[dict[str, Any]] = []

    def is_due(self, step: int) -> bool:
        """True when this step may be guided."""
        return self.guidance.is_due(step)

    def add(self, step: int, gaussians: Gaussians, settings: RasterSettings, gradients: Gradients) -> None:
        """Guide this step if it is to be guided."""
        more = self.guidance.gradients(step, gaussians, settings)
        if more is None:
            return
        add_gradients(gradients, more)
        known, last = self.guidance.memory.coverage, self.guidance.last
        if self._folder is None or known is None or last is None:
            return
        if not self._views:
            self._views = self._report_views(known)
            self._save_views(self._folder, "before", gaussians, settings)
        if self.guidance.memory.counts.guided in report_counts(self._planned):
            self._save_sample(self._folder, last)

    def forget(self) -> None:
        self.guidance.forget()

    def finish(self, gaussians: Gaussians, settings: RasterSettings) -> None:
        """The last pictures and summary.json, for the report."""
        if self._folder is None:
            return
        if self._views:
            self._save_views(self._folder, "after", gaussians, settings)
        summary = {
            **self._facts,
            "wanted": self._planned,
            **dataclasses.asdict(self.guidance.memory.counts),
            "views": self._views,
            "samples": self._samples,
        }
        write_atomic(self._folder / "summary.json", to_json(summary))

    def _report_views(self, known: CoverageRecord) -> list[int]:
        """Candidates whose views are the most uncertain, from different directions."""
        candidates = self.guidance.observer.cameras.candidates
        chosen: list[int] = []
        for index in torch.sort(known.mean_u, descending=True, stable=True).indices.tolist():
            cosines = candidates.forwards[chosen] @ candidates.forwards[index]
            if len(chosen) < REPORT_VIEWS and bool((cosines < MAX_VIEW_COSINE).all()):
                chosen.append(index)
        return chosen

    def _save_views(self, folder: Path, when: str, gaussians: Gaussians, settings: RasterSettings) -> None:
        observer = self.guidance.observer
        known = self.guidance.memory.coverage or observer.coverage(0, gaussians)
        white = torch.ones(3)
        for index in self._views:
            camera = observer.cameras.candidates[index]
            colors = observer.backend.forward(gaussians, camera, settings, white).colors
            uncertainty = observer.uncertainty(gaussians, known.covered, camera)
            name = f"{when}_{index:02d}"
            pictures = [(name, to_bytes(colors)), (f"{name}_uncertainty", _gray(uncertainty))]
            save_stills(folder, pictures, overwrite=True)

    def _save_sample(self, folder: Path, record: StepRecord) -> None:
        """The render that the prior got in a step, and its proposal."""
        name = f"step_{record.step:06d}"
        pictures = [
            (f"{name}_render", to_bytes(record.render.permute(1, 2, 0))),
            (f"{name}_proposal", to_bytes(record.proposal(self.guidance.prior).permute(1, 2, 0))),
            (f"{name}_uncertainty", _gray(record.uncertainty)),
        ]
        save_stills(folder, pictures, overwrite=True)
        self._samples = [s for s in self._samples if s["step"] != record.step]
        self._samples.append({"step": record.step, "text": record.text})

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The state of `Guidance`, and the report's views and samples."""
        tensors, meta = self.guidance.state()
        return tensors, {**meta, "views": self._views, "samples": self._samples}

    def restore(self, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        self.guidance.restore(tensors, meta)
        self._views, self._samples = list(meta["views"]), list(meta["samples"])


def report_counts(planned: int) -> set[int]:
    """Guided steps, by their count, with pictures in the report: the first and three more, evenly spread."""
    return {1 + i * (planned - 1) // (REPORT_STEPS - 1) for i in range(REPORT_STEPS)} if planned > 1 else {1}


def _gray(values: Tensor) -> Tensor:
    return to_bytes(values[..., None].expand(-1, -1, 3))
