"""Memory and time of a run on the CPU, estimated before its first step.

Both are linear in what a run holds and draws. The constants were fitted to the suite `sparse` (docs/results.md; AMD
EPYC, AVX-512), and a test compares them with its records: memory within a fifth, time within a factor of 2.6.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from gsopt import check
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import InputError
from gsopt.training.open_settings import open_settings
from gsopt.training.plan import RunPlan, default_budget
from gsopt.training.targets import content_pixels

BASE_BYTES = 340_000_000
"""The interpreter with torch and the evaluation's networks."""
COPIES, STILL_COPIES = 8, 5
"""Parameters, gradients, two moments, and what growing takes while rows are added, or only their first state."""
FROZEN_COPIES = 3
"""Frozen Gaussians: themselves, beside those of the run, and gradients that nobody uses."""
SPLAT_BYTES = 700
"""A splat in the kernels' buffers and lists of tiles."""
PIXEL_BYTES = 120
"""A pixel of the image that is drawn: itself, its gradient, the loss's maps."""
SECONDS_PER_PIXEL, SECONDS_PER_GAUSSIAN = 5.2e-8, 1.77e-7
"""CPU time of a step."""
MEBIBYTE = 1 << 20


@dataclass(frozen=True)
class Estimate:
    """Bytes at the peak, and seconds on one core."""

    gaussians: int
    """Number that the run will probably have at its end."""
    gaussian_bytes: int
    """Bytes of each."""
    image_bytes: int
    seconds: float
    frozen_bytes: int = 0
    """Bytes of Gaussians that are drawn and stay as they are."""

    @property
    def memory(self) -> int:
        return BASE_BYTES + self.gaussians * self.gaussian_bytes + self.image_bytes + self.frozen_bytes

    def require(self, limit: int) -> None:
        """Raises InputError, with what to change, where `limit` bytes do not suffice."""
        if self.memory <= limit:
            return
        room = (limit - self.memory) // self.gaussian_bytes + self.gaussians
        fewer = f"--max-gaussians {room // 1000 * 1000}, " if room >= 1000 else ""
        raise InputError(
            f"This run needs about {gigabytes(self.memory)} ({gigabytes(self.gaussians * self.gaussian_bytes)} for "
            f"{self.gaussians:,} Gaussians, {gigabytes(self.image_bytes)} for images), there are {gigabytes(limit)}. "
            f"Give {fewer}a smaller image (-r 2), a smaller cache (--cache-mb 100), or another --max-memory."
        )


def estimate(config: TrainConfig, plan: RunPlan, scene: Scene, frozen: int = 0) -> Estimate:
    """The estimate for a run on the CPU that draws so many frozen Gaussians with its own."""
    steps, budget = plan.schedule.iterations, plan.density.max_gaussians
    views = len(scene.train)
    per_pixel = open_settings(config.sparse, views, masked=scene.has_alpha).gaussians_per_pixel
    expected = max(default_budget(content_pixels(scene.train), views, steps, per_pixel), config.init.count)
    full = plan.density.strategy == "mcmc" or config.cell.start
    pixels = max(view.camera.width * view.camera.height for view in scene.drawn)
    count, images = budget if full else min(budget, expected), image_bytes(config, plan, scene)
    return of_sizes(count, plan.schedule.max_sh_degree, pixels, images, steps, frozen, plan.schedule.refine_stop > 0)


def image_bytes(config: TrainConfig, plan: RunPlan, scene: Scene) -> int:
    """Bytes of decoded images and of targets that a run keeps."""
    channels = 4 if scene.has_alpha else 3
    sizes = [view.camera.width * view.camera.height for view in scene.drawn]
    decoded = channels * (sum(sizes) + sum(view.camera.width * view.camera.height for view in scene.test))
    targets = min(int(plan.target_cache_mb * MEBIBYTE), 4 * channels * sum(sizes))
    return min(decoded, config.data.cache_mb * MEBIBYTE) + targets


def of_sizes(
    gaussians: int, sh_degree: int, pixels: int, images: int, steps: int, frozen: int = 0, growing: bool = True
) -> Estimate:
    """The estimate for `gaussians` and `frozen` ones drawn into `pixels`, beside `images` bytes of photos and targets;
    `growing`: Gaussians are added and removed."""
    row = 4 * (11 + 3 * (sh_degree + 1) ** 2)
    each = row * (COPIES if growing else STILL_COPIES) + SPLAT_BYTES
    seconds = steps * (SECONDS_PER_PIXEL * pixels + SECONDS_PER_GAUSSIAN * (gaussians + frozen))
    beside = frozen * (row * FROZEN_COPIES + SPLAT_BYTES)
    return Estimate(gaussians, each, images + pixels * PIXEL_BYTES, seconds, beside)


def memory_limit(config: TrainConfig) -> int | None:
    """Bytes that the run may take: `--max-memory`, else what is free, or None on a system that does not report it."""
    return check.byte_count("--max-memory", config.max_memory) if config.max_memory else free_memory()


def free_memory(root: Path = Path("/")) -> int | None:
    """Bytes that this machine, or the container around this process, has left, or None without a report of them."""
    found: list[int] = []
    with contextlib.suppress(OSError, ValueError, IndexError, StopIteration):
        lines = (root / "proc/meminfo").read_text(encoding="ascii").splitlines()
        found.append(1024 * int(next(line for line in lines if line.startswith("MemAvailable:")).split()[1]))
    with contextlib.suppress(OSError, ValueError):
        most, used = (
            (root / f"sys/fs/cgroup/memory.{name}").read_text(encoding="ascii") for name in ("max", "current")
        )
        found.append(max(0, int(most) - int(used)))
    return min(found, default=None)


def gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{max(size, 0) / 1e6:.0f} MB"
