"""The number of cells, and estimates of memory and time, before anything starts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import timedelta

from gsopt.config.cells import AUTO, MAX_CELLS
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import InputError, UsageError
from gsopt.training.cells.stages import CELL_SHARE, COARSE_SHARE, POLISH_SHARE
from gsopt.training.estimate import Estimate, gigabytes, image_bytes, memory_limit, of_sizes
from gsopt.training.plan import RunPlan

OVERLAPPING = 1.3
"""Gaussians of a cell with those of its margin, over its own."""
VIEWED = 2.0
"""Number of cells that see a view."""


@dataclass(frozen=True)
class Sizes:
    """The estimates for so many cells."""

    count: int
    coarse: Estimate
    cell: Estimate
    polish: Estimate
    whole: Estimate
    """One run instead."""
    polished: bool
    """True when the polish fits into memory."""

    @property
    def memory(self) -> int:
        """Most bytes that a run needs."""
        return max(part.memory for part in (self.coarse, self.cell, self.polish if self.polished else self.cell))

    def __str__(self) -> str:
        last = self.polish.seconds if self.polished else 0.0
        time = timedelta(seconds=round(self.coarse.seconds + self.count * self.cell.seconds + last))
        polish = "" if self.polished else f"; no joint polish, which would need {gigabytes(self.polish.memory)}"
        return (
            f"{self.count} cells, estimate: about {gigabytes(self.memory)} of memory (one run: "
            f"{gigabytes(self.whole.memory)}), {time} of one core{polish}"
        )


def cell_sizes(config: TrainConfig, plan: RunPlan, scene: Scene) -> Sizes:
    """The number of cells that `--cells` asks for and what they take.

    Raises UsageError where cells make no sense, InputError, with what would fit, where memory does not suffice.
    """
    views = len(scene.train)
    if plan.sparse:
        raise UsageError(
            f"`--cells` is for big scenes: {scene.path} has {views} input view{'s' * (views != 1)}, few enough for one "
            "run with regularizers. Leave --cells out."
        )
    most = min(MAX_CELLS, views)
    limit = memory_limit(config)
    images = image_bytes(config, plan, scene)
    if config.cells != AUTO:
        if int(config.cells) > most:
            raise UsageError(f"`--cells` must be at most the {views} input views, got {config.cells}. Lower it.")
        sizes = sizes_of(int(config.cells), config, plan, scene, limit, images)
    else:
        tried = (sizes_of(count, config, plan, scene, limit, images) for count in range(2, most + 1))
        sizes = next((one for one in tried if _fits(one, limit)), sizes_of(most, config, plan, scene, limit, images))
    if not _fits(sizes, limit):
        assert limit is not None
        more = (sizes_of(count, config, plan, scene, limit, images) for count in range(sizes.count + 1, most + 1))
        enough = next((f"--cells {one.count}, " for one in more if _fits(one, limit)), "")
        raise InputError(
            f"{sizes.count} cells need about {gigabytes(max(sizes.coarse.memory, sizes.cell.memory))} each, there are "
            f"{gigabytes(limit)}. Give {enough}fewer Gaussians (--max-gaussians), a smaller image (-r 2), a smaller "
            "cache (--cache-mb 100), or another --max-memory."
        )
    return sizes


def sizes_of(count: int, config: TrainConfig, plan: RunPlan, scene: Scene, limit: int | None, images: int) -> Sizes:
    """The estimates for so many cells."""
    degree, budget, steps = plan.schedule.max_sh_degree, plan.density.max_gaussians, config.iterations
    pixels = max(view.camera.width * view.camera.height for view in scene.train)
    part = math.ceil(budget / count)
    wide = math.ceil(OVERLAPPING * part)
    cell_steps = math.ceil(CELL_SHARE * steps * min(1.0, VIEWED / count))
    polish = of_sizes(budget, degree, pixels, images, math.ceil(POLISH_SHARE * steps), growing=False)
    return Sizes(
        count,
        of_sizes(part, degree, pixels, images, math.ceil(COARSE_SHARE * steps)),
        of_sizes(wide, degree, pixels, images, cell_steps, frozen=part),
        polish,
        of_sizes(budget, degree, pixels, images, steps),
        limit is None or polish.memory <= limit,
    )


def _fits(sizes: Sizes, limit: int | None) -> bool:
    return limit is None or max(sizes.coarse.memory, sizes.cell.memory) <= limit
