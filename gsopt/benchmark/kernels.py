"""Speed of the compiled kernels: full training iterations over scenes of surfaces, stage by stage.

A full iteration is projection, SH of degree 3, sort and binning, blending, L1 + D-SSIM, its gradient through all of
that, and one Adam step of every parameter.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check
from gsopt.benchmark.stopwatch import Reading, both, repeat
from gsopt.benchmark.surface_scene import surface_scene
from gsopt.config.train import OptimizerConfig
from gsopt.errors import UsageError
from gsopt.gaussians import PARAMETERS
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.raster.cpu_backend import CpuBackend
from gsopt.training.optimizer import OptimizedGaussians, adam_step

CASES = ("200x200/20k", "400x400/50k", "800x800/100k", "800x800/300k")
CASE_PATTERN = re.compile(r"(\d+)x(\d+)/(\d+)(k|M|)")
UNITS = {"": 1, "k": 1_000, "M": 1_000_000}
LAMBDA_DSSIM = 0.2
# Least cost of one pair of pixel and splat beside one exponential, in fused multiply-adds (or other operations of the
# same pipes). Forward: 5 for the exponent, 1 for the weight, 4 for transmittance and colors. Backward: 5 and 10 for
# their gradients, and 10 for the nine sums over the pixels of a block, most of which are shuffles and additions.
FORWARD_FMAS, BACKWARD_FMAS = 10, 25


@dataclass(frozen=True)
class Case:
    """One scene."""

    name: str
    width: int
    height: int
    count: int

    @staticmethod
    def parse(name: str) -> Case:
        """The case named "800x800/100k"; UsageError for anything else."""
        match = CASE_PATTERN.fullmatch(name)
        if match is None:
            raise UsageError(f"`--case` must be WIDTHxHEIGHT/COUNT, got {name!r}. Try one of {', '.join(CASES)}.")
        case = Case(name, int(match[1]), int(match[2]), int(match[3]) * UNITS[match[4]])
        for side in (case.width, case.height):
            check.within("--case", side, 1, 16384, "Give the image size in pixels.")
        check.within("--case", case.count, 1, 100_000_000, "Give the number of Gaussians.")
        return case


def read_count(flag: str, text: str) -> int:
    """12k, 3M or 500 as a number; UsageError for anything else."""
    match = re.fullmatch(r"(\d+)(k|M|)", text)
    if match is None:
        raise UsageError(f"`{flag}` must be numbers like 500, 12k or 3M, got {text!r}. Try 12k.")
    count = int(match[1]) * UNITS[match[2]]
    check.within(flag, count, 1, 100_000_000, "Give a number of Gaussians.")
    return count


class Iteration:
    """A training iteration that can be repeated: the model changes a little each time, as in training."""

    def __init__(self, case: Case, threads: int) -> None:
        self.backend = CpuBackend(threads)
        gaussians, self.camera = surface_scene(case.count, case.width, case.height)
        self.model = OptimizedGaussians.start(gaussians)
        self.settings = RasterSettings()
        self.config = OptimizerConfig()
        # Rates so small that the scene does not change between the first and the last repetition.
        self.rates = dict.fromkeys(PARAMETERS, 1e-10)
        self.target = blurred_noise(self.camera)
        self.gradients: Gradients | None = None
        """Gradients of the last iteration; the next one reuses their memory, as the trainer does."""

    def run(self) -> None:
        """One full iteration."""
        frame = self.backend.forward(self.model.gaussians, self.camera, self.settings)
        loss = self.backend.photometric(frame.colors, self.target, LAMBDA_DSSIM)
        self.gradients = self.backend.backward(frame, loss.v_colors, bands=False, into=self.gradients)
        adam_step(self.model, self.gradients, self.rates, self.config, self.backend, self.camera, self.settings)

    def render(self) -> None:
        """One forward pass."""
        frame = self.backend.forward(self.model.gaussians, self.camera, self.settings)
        self.backend.release(frame)

    def work(self) -> tuple[int, int, int]:
        """(tile intersections, splat-block entries evaluated, contributing splat-pixel pairs) of one frame."""
        workspace = self.backend._workspace
        before = workspace.work
        workspace.count_work = True
        frame = self.backend.forward(self.model.gaussians, self.camera, self.settings)
        workspace.count_work = False
        intersections = int(frame.context.frame.intersections)  # type: ignore[attr-defined]
        self.backend.release(frame)
        entries, pairs = (after - start for after, start in zip(workspace.work, before, strict=True))
        return intersections, int(entries), int(pairs)

    def stage_clocks(self) -> dict[str, Reading]:
        """Seconds per stage since this backend was made."""
        workspace = self.backend._workspace
        return {name: Reading(cpu, workspace.seconds[name]) for name, cpu in workspace.cpu_seconds.items()}


def blurred_noise(camera: Cameras) -> Float[Tensor, "H W 3"]:
    """The training image of the iteration."""
    noise = torch.rand(1, 3, camera.height, camera.width, generator=torch.Generator().manual_seed(1))
    return torch.nn.functional.avg_pool2d(noise, 5, 1, 2)[0].permute(1, 2, 0).contiguous()


def measure(case: Case, threads: int, repetitions: int, rates: dict[str, dict[str, float]]) -> dict[str, Any]:
    """One record (`schema.CASE`); `rates` is `machine.calibration()`."""
    iteration = Iteration(case, threads)
    stages: list[dict[str, Reading]] = []

    def run_and_note() -> None:
        before = iteration.stage_clocks()
        iteration.run()
        stages.append(difference(iteration.stage_clocks(), before))

    readings = repeat(run_and_note, repetitions)
    stages = stages[-repetitions:]
    by_stage = {name: both([stage[name] for stage in stages]) for name in stages[0]}
    intersections, entries, pairs = iteration.work()
    isa = iteration.backend.isa
    lanes = entries * LANES[isa]
    core = {name: core_seconds(by_stage[name], iteration.backend.threads) for name in ("blend", "blend_backward")}
    drawn = repeat(iteration.render, repetitions)
    rendering = both(drawn)
    return {
        "case": case.name,
        "threads": iteration.backend.threads,
        "isa": isa,
        "width": case.width,
        "height": case.height,
        "gaussians": case.count,
        "repetitions": repetitions,
        **both(readings),
        "stages": by_stage,
        "intersections": intersections,
        "entries": entries,
        "useful_pairs": pairs,
        "lane_use": pairs / lanes,
        "pairs_per_second": {"forward": pairs / core["blend"], "backward": pairs / core["blend_backward"]},
        "share_of_bound": {
            "forward": bound(lanes, FORWARD_FMAS, rates[isa]) / core["blend"],
            "backward": bound(lanes, BACKWARD_FMAS, rates[isa]) / core["blend_backward"],
        },
        "render": {**rendering, "frames_per_second": 1000 / rendering["wall_ms"]["median"]},
    }


LANES = {"avx512": 16, "avx2x2": 16, "avx2": 8, "portable": 8, "neon": 8}
"""Pixels per block, the vector width of the kernels."""


def bound(lanes: int, fmas: int, rates: dict[str, float]) -> float:
    """Least seconds of one core for `lanes` lanes, each of one exponential and `fmas` multiply-adds."""
    return lanes * (fmas / rates["fma_per_second"] + 1 / rates["exp_per_second"])


def core_seconds(stage: dict[str, Any], threads: int) -> float:
    """Seconds of a stage over all its cores. With several threads this is wall time times threads, because the clock of
    a process counts the time of its other threads only at the scheduler's ticks, long after a stage."""
    milliseconds = stage["cpu_ms"]["median"] if threads == 1 else threads * stage["wall_ms"]["median"]
    return milliseconds / 1000


def difference(after: dict[str, Reading], before: dict[str, Reading]) -> dict[str, Reading]:
    none = Reading(0.0, 0.0)
    return {
        name: Reading(reading.cpu - before.get(name, none).cpu, reading.wall - before.get(name, none).wall)
        for name, reading in after.items()
    }
