"""The parts of a run that depend on the step, counted from 1 to `iterations`, and the check for a flat loss."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsopt.config.train import OptimizerConfig
from gsopt.training.averaging import SHARE
from gsopt.training.optimizer import learning_rates

STEPS_AFTER_RESET = 2000
"""Steps that opacities need to recover from a reset: none is made later than this before the end."""
TURNOVERS = (1 / 2, 2 / 3, 5 / 6)
"""Shares of the steps up to the last refinement after which what adds least to the input views makes room."""
FLOATER_SIGMAS = (4.0, 2.0)
"""Distance of a floater to its neighbors beyond the mean, in standard deviations, at the first and the last step."""


@dataclass(frozen=True)
class Schedule:
    """Answers, for every step of a run, what is due in it."""

    iterations: int
    extent: float
    """Extent of the scene, scene units: the unit of the rates of the means."""
    optimizer: OptimizerConfig
    """With nothing left open."""
    lr_means_first: float
    """Learning rate of the means at the first step, over the extent."""
    sh_degree_every: int
    """Steps between two bands of the spherical harmonics."""
    settling: int
    """Number of last steps in which the learning rates fall."""
    coarse_until: tuple[int, ...]
    """Steps after which the resolution doubles."""
    agreed_until: int
    """Last step at which depths on which photos agree are a target."""
    max_sh_degree: int
    """Highest band of the spherical harmonics that the run stores."""
    refine_start: int
    refine_stop: int
    """Last step after which Gaussians may be added or removed."""
    refine_every: int
    reset_every: int
    """Steps between two opacity resets of adc; 0 = never."""
    max_dropout: float
    """Largest share of Gaussians left out of a step."""
    most_dropout_at: int
    """Step with the largest share."""
    floater_every: int
    """Steps between two prunings of floaters; 0 = never."""
    haze_every: int
    """Steps between two removals of haze; 0 = never."""

    @property
    def averages_after(self) -> int:
        """The step after which Gaussians are averaged: none are added from there on."""
        return max(self.refine_stop, *self.coarse_until, self.iterations - round(SHARE * self.iterations))

    def learning_rates(self, step: int, last: int) -> dict[str, float]:
        """Rate of every parameter in a run that ends with step `last`; that of the means in scene units per step."""
        share = self.lr_share(step, last)
        return learning_rates(self.optimizer, share * self.lr_means(step), share)

    def lr_means(self, step: int) -> float:
        """Log-linear from lr_means to lr_means_final, times the scene extent: scene units per step."""
        first, last = self.lr_means_first, self.optimizer.lr_means_final
        if first <= 0 or last <= 0:
            return 0.0
        return self.extent * first * (last / first) ** (step / self.iterations)

    def lr_share(self, step: int, last: int) -> float:
        """Share of the rates at a step of a run that ends with step `last`: 1, then log-linearly down to `lr_last`."""
        into = step - (last - self.settling)
        return 1.0 if into <= 0 else float(self.optimizer.lr_last ** (into / self.settling))

    def sh_degree(self, step: int) -> int:
        """Highest band that is drawn: one more every `sh_degree_every` steps. 0 before the first step."""
        return min(self.max_sh_degree, max(0, step - 1) // self.sh_degree_every)

    def downscale(self, step: int) -> int:
        """Divisor of width and height: halved for every entry of `coarse_until` that the step has passed."""
        return int(2 ** sum(step <= until for until in self.coarse_until))

    def refines(self, step: int) -> bool:
        """True when Gaussians are added and removed after this step."""
        return step % self.refine_every == 0 and self.refine_start < step <= self.refine_stop

    def next_refinement(self, step: int) -> int | None:
        """The first step from this one on that `refines`, None where there is none."""
        due = math.ceil(max(step, self.refine_start + 1) / self.refine_every) * self.refine_every
        return due if due <= self.refine_stop else None

    def resets(self, step: int) -> bool:
        """True when adc lowers the opacities after this step (Kerbl et al. 2023, section 5.2)."""
        if self.reset_every == 0 or step % self.reset_every != 0:
            return False
        return step <= min(self.refine_stop, self.iterations - STEPS_AFTER_RESET)

    def turns_over(self, step: int) -> bool:
        """True when Gaussians that add little to the input views make room after this step, for those added then."""
        due = (round(share * self.refine_stop / self.refine_every) * self.refine_every for share in TURNOVERS)
        return self.refines(step) and step in due

    def prunes_large(self, step: int) -> bool:
        """True once opacities were reset: from then on adc removes large Gaussians."""
        return 0 < self.reset_every < step

    def dropout(self, step: int) -> float:
        """Share of Gaussians left out of a step: rises linearly (DropGaussian, Park et al. 2025), then falls to 0."""
        if step <= self.most_dropout_at:
            return self.max_dropout * step / self.most_dropout_at
        return self.max_dropout * (self.iterations - step) / (self.iterations - self.most_dropout_at)

    def prunes_floaters(self, step: int) -> bool:
        """True when floaters are removed after this step; never after the last, which would leave holes."""
        return self.floater_every > 0 and step % self.floater_every == 0 and step < self.iterations

    def removes_haze(self, step: int, last: int) -> bool:
        """True when haze is removed after this step of a run that ends with step `last`, and after that."""
        return self.haze_every > 0 and (step % self.haze_every == 0 or step == last)

    def floater_sigmas(self, step: int) -> float:
        """Distance from the mean distance beyond which a Gaussian is a floater, in standard deviations.

        GaussianObject (Yang et al. 2024) lowers it linearly to 0, which would end by removing about half of all.
        """
        first, last = FLOATER_SIGMAS
        return first + (last - first) * step / self.iterations

    def is_settled(self, step: int) -> bool:
        """True once the set of Gaussians and the resolution no longer change."""
        return step > max(self.refine_stop, *self.coarse_until, 0)

    def is_complete(self, step: int) -> bool:
        """True once moreover all bands are drawn: from here on a flat loss may end the run."""
        return self.is_settled(step) and step > self.max_sh_degree * self.sh_degree_every


@dataclass
class Flatness:
    """Finds when the loss no longer falls: `stop_when_flat`.

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
