"""What depends on the step: pure functions of the configuration, and when a run is done early.

Steps count from 1 to `iterations`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from gsopt.config.train import MAX_GAUSSIANS, DensityConfig, OptimizerConfig, TrainConfig

# Published end of refinement (Kerbl et al. 2023; Kheradmand et al. 2024), and its share of a shorter run.
REFINE_STOP = {"adc": (15_000, 0.6), "mcmc": (25_000, 0.83)}
# Shares of a run drawn at a quarter and at half of the resolution. Early steps only move coarse shapes; with few views
# a longer coarse phase keeps fine detail from being learned as view-dependent fog (docs/decisions/0001-schedule.md).
COARSE, COARSE_SPARSE = (0.06, 0.23), (1 / 6, 1 / 2)
# The default budget, per pixel of an image that shows something, for 7000 steps: adc left to itself ends near it.
GAUSSIANS_PER_PIXEL = 1.44
SMALLEST_BUDGET, LARGEST_BUDGET = 20_000, 1_000_000
# Mirror images drawn per epoch, times the number of photos: the more photos there are, the less they leave open and the
# more the images blur what the photos show (docs/decisions/0002-symmetry.md).
MIRRORED = 32
# A reset takes about this many steps to heal: none is made so late that the run would end with its scar.
STEPS_AFTER_RESET = 2000
# Share of a run in which the rates fall, so that it does not end in the noise of the last few views it drew.
SETTLING = 0.05
# Floaters: distance to the neighbours beyond the mean, in standard deviations, at the first and at the last step.
FLOATER_SIGMAS = (4.0, 2.0)


@dataclass(frozen=True)
class Weights:
    """What is added to the photometric loss of a run."""

    alpha: float
    opacity: float
    scale: float


def is_sparse(config: TrainConfig, views: int) -> bool:
    """Whether the regularisers for few views are on."""
    return views <= config.sparse.below_views


def shortened(config: TrainConfig, views: int) -> TrainConfig:
    """The configuration with no more steps than few views can use."""
    if config.sparse.steps_per_view == 0 or not is_sparse(config, views):
        return config
    return replace(config, iterations=min(config.iterations, config.sparse.steps_per_view * views))


def mirrored_per_epoch(views: int, images: int) -> int:
    """How many of the mirror images are drawn beside every input view once."""
    return min(images, round(MIRRORED / views))


def weights(config: TrainConfig, views: int) -> Weights:
    """The run's weights: LossConfig's (0.01 for mcmc's two, Kheradmand et al. 2024), or SparseConfig's if larger."""
    loss, sparse = config.loss, config.sparse
    default = 0.01 if config.density.strategy == "mcmc" else 0.0
    alpha = loss.lambda_alpha
    opacity = default if loss.lambda_opacity is None else loss.lambda_opacity
    scale = default if loss.lambda_scale is None else loss.lambda_scale
    if not is_sparse(config, views):
        return Weights(alpha, opacity, scale)
    return Weights(
        max(alpha, sparse.lambda_alpha), max(opacity, sparse.lambda_opacity), max(scale, sparse.lambda_scale)
    )


def max_sh_degree(config: TrainConfig, views: int) -> int:
    """Highest band a run stores: few views cannot tell view dependence from shape."""
    degree = config.optimizer.sh_degree
    return min(degree, config.sparse.sh_degree) if is_sparse(config, views) else degree


def sh_degree(step: int, config: OptimizerConfig, highest: int) -> int:
    """Bands are switched on one by one (Kerbl et al. 2023)."""
    return min(highest, (step - 1) // config.sh_degree_every)


def lr_means(step: int, iterations: int, config: OptimizerConfig, extent: float) -> float:
    """Log-linear from lr_means to lr_means_final, times the scene extent: scene units per step."""
    first, last = config.lr_means, config.lr_means_final
    if first <= 0 or last <= 0:
        return 0.0
    return extent * first * (last / first) ** (step / iterations)


def settling_steps(config: TrainConfig, views: int) -> int:
    """How many of the last steps have falling rates. None with few views: there the noise of single steps keeps those
    views from being learned by heart (docs/decisions/0001-schedule.md)."""
    return 0 if is_sparse(config, views) else math.ceil(SETTLING * config.iterations)


def lr_share(step: int, last: int, settling: int, config: OptimizerConfig) -> float:
    """Share of the rates at a step of a run that ends with step `last`: 1, then log-linearly down to `lr_last`."""
    into = step - (last - settling)
    return 1.0 if into <= 0 else float(config.lr_last ** (into / settling))


def coarse_until(config: TrainConfig, views: int) -> tuple[int, ...]:
    """Last steps at a quarter and at half of the resolution, as given or as shares of the run."""
    if config.schedule.coarse_until is not None:
        return config.schedule.coarse_until
    shares = COARSE_SPARSE if is_sparse(config, views) else COARSE
    steps = (round(share * config.iterations) for share in shares)
    return tuple(step for step in steps if step > 0)


def max_gaussians(config: TrainConfig, pixels: float) -> int:
    """The budget as given, or what `pixels`, those of an image that show something, can use in a run this long."""
    if config.density.max_gaussians is not None:
        return config.density.max_gaussians
    longer = config.iterations / 7000
    wanted = round(GAUSSIANS_PER_PIXEL * pixels * max(longer, math.sqrt(longer)))
    return min(max(wanted, SMALLEST_BUDGET), LARGEST_BUDGET)


def budget(config: DensityConfig) -> int:
    """The resolved limit on the number of Gaussians."""
    return MAX_GAUSSIANS if config.max_gaussians is None else config.max_gaussians


def downscale(step: int, coarse_until: tuple[int, ...]) -> int:
    """By how much width and height are divided at this step: halved for every entry not yet passed."""
    return int(2 ** sum(step <= until for until in coarse_until))


def refine_stop(config: DensityConfig, iterations: int) -> int:
    """Last step after which Gaussians may be added or removed."""
    if config.refine_stop is not None:
        return config.refine_stop
    published, share = REFINE_STOP[config.strategy]
    return min(published, round(share * iterations))


def refines(step: int, config: DensityConfig, iterations: int) -> bool:
    """Whether Gaussians are added and removed after this step."""
    due = step % config.refine_every == 0
    return due and config.refine_start < step <= refine_stop(config, iterations)


def resets(step: int, config: DensityConfig, iterations: int) -> bool:
    """Whether adc lowers the opacities after this step (Kerbl et al. 2023, section 5.2)."""
    if config.reset_every == 0 or step % config.reset_every != 0:
        return False
    return step <= min(refine_stop(config, iterations), iterations - STEPS_AFTER_RESET)


def dropout(step: int, iterations: int, config: TrainConfig) -> float:
    """Share of Gaussians left out of a step with few views: rises linearly (DropGaussian, Park et al. 2025)."""
    return config.sparse.dropout * step / iterations


def prunes_floaters(step: int, iterations: int, config: TrainConfig) -> bool:
    """Whether floaters are removed after this step; never after the last, which would leave holes."""
    every = config.sparse.floater_every
    return every > 0 and step % every == 0 and step < iterations


def floater_sigmas(step: int, iterations: int) -> float:
    """How far from the mean distance a Gaussian must lie to be a floater, in standard deviations.

    GaussianObject (Yang et al. 2024) lowers it linearly to 0, which would end by removing about half of all.
    """
    first, last = FLOATER_SIGMAS
    return first + (last - first) * step / iterations


@dataclass
class Flatness:
    """Says when the loss no longer falls: `stop_when_flat`.

    The mean loss is taken over windows of whole epochs (at least 100 steps). A window counts as progress when its mean
    lies 0.2 % below the best so far; five windows in a row without progress end the run. Only steps after the last
    refinement count, because a refinement raises the loss for a while.
    """

    window: int
    total: float = 0.0
    count: int = 0
    best: float = float(2**31)
    stale: int = 0

    GAIN = 0.002
    PATIENCE = 5

    @staticmethod
    def of(views: int) -> Flatness:
        return Flatness(window=views * -(-100 // views))

    def update(self, loss: float) -> bool:
        """Take one step's loss; True when the run should end."""
        self.total += loss
        self.count += 1
        if self.count < self.window:
            return False
        mean = self.total / self.count
        self.stale = 0 if mean < self.best * (1 - self.GAIN) else self.stale + 1
        self.best = min(self.best, mean)
        self.total, self.count = 0.0, 0
        return self.stale >= self.PATIENCE
