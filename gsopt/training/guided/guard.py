"""The guard: short runs without one input view measure whether guidance helps, before the run itself is guided.

A view that the model has learned from is no measure: any prior only blurs what is known. So every view that is left out
gets a model that never saw it, first Gaussians included.

A view-conditioned prior predicts that model's render of the view: only one whose predictions are closer to the left-out
views, by REPAIR at least, guides the run. docs/howto/guidance.md has the gain that follows.

Single predictions of a text-to-image prior mean little. For it a second model is guided, the same in all else. While
that lowers the mean PSNR of the left-out views, lambda is halved and tried again; after three trials it is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import InitConfig, ScheduleConfig, TrainConfig
from gsopt.data.scene import Scene, View
from gsopt.errors import NumericalError
from gsopt.geometry.farthest_points import farthest_points
from gsopt.init import first_gaussians
from gsopt.metrics import capped_psnr
from gsopt.raster.backend import Backend
from gsopt.sds.guidance_plan import resolved_every
from gsopt.sds.guidance_step import GuidanceSetup
from gsopt.training.guided.session import RunGuidance
from gsopt.training.plan import RunPlan
from gsopt.training.targets import Targets
from gsopt.training.trainer import Trainer

MIN_GAIN = 0.5
"""dB. Runs with a view less are easier to repair than the run's own: by this much, a prior that knows nothing more may
seem to help."""
NOISE_LEVELS = 4
"""Noise levels of the predictions for each left-out view, those of the guided steps."""
FACTORS = (1.0, 0.5, 0.25)
SHORT_RUN_SIDE = 128
"""Longer side of the images of a short run, px, as near as halving comes."""
SHORT_RUN_GAUSSIANS = 5000
WHITE = torch.ones(3)


@dataclass(frozen=True)
class Verdict:
    """The guard's decision."""

    factor: float
    """On lambda."""
    reason: str
    trials: list[dict[str, Any]]
    """Per left-out view: its name and the PSNR gain of the predictions, dB. For a text-to-image prior, per trial:
    factor, and mean PSNR of the left-out views with and without guidance, dB."""


@dataclass(frozen=True)
class HeldOutView:
    """One input view left out."""

    scene: Scene
    """Without it."""
    view: View


@dataclass(frozen=True)
class ShortRun:
    """Short runs, alike in all but the scene and its guidance."""

    config: TrainConfig
    backend: Backend

    def trained(self, scene: Scene, setup: GuidanceSetup | None) -> Trainer:
        """A run at its end."""
        plan = RunPlan.of(self.config, scene)
        gaussians, _ = first_gaussians(scene, plan.init, plan.schedule.max_sh_degree, plan.seed)
        guidance = None if setup is None else RunGuidance(setup.on(scene, self.backend, plan.guidance))
        trainer = Trainer(plan, scene, gaussians, self.backend, guidance)
        while trainer.step < plan.schedule.iterations:
            trainer.advance()
        return trainer

    def render(
        self, left_out: HeldOutView, setup: GuidanceSetup | None
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
        """Render of the left-out view after a run on the others, 0..1 on white, and its photo."""
        trainer = self.trained(left_out.scene, setup)
        target = Targets([left_out.view], WHITE, 0).get(0, trainer.plan.schedule.downscale(1), WHITE)
        colors = self.backend.forward(trainer.model.gaussians, target.camera, trainer.settings(), WHITE).colors
        return colors.clamp(0, 1).cpu(), target.colors


def evaluate_guidance(config: TrainConfig, scene: Scene, backend: Backend, setup: GuidanceSetup) -> Verdict:
    """The share of its weight that guidance gets in the run, measured on input views that were left out."""
    guidance, aligned = config.guidance, setup.prior.aligned
    if guidance.guard_views == 0:
        return Verdict(1.0, "not checked: --guidance.guard-views is 0", [])
    if len(scene.train) < 2:
        only = "one input view cannot say whether it helps"
        return Verdict(0.0, f"off: {only}", []) if aligned else Verdict(1.0, f"not checked: {only}", [])
    short = ShortRun(short_config(config, scene, aligned), backend)
    held_out = [without(scene, index) for index in spread_views(scene, guidance.guard_views)]
    check = _check_predictions if aligned else _check_guided_runs
    return check(short, held_out, setup)


def _check_predictions(short: ShortRun, held_out: list[HeldOutView], setup: GuidanceSetup) -> Verdict:
    """Passes a prior whose predictions are closer to the left-out views than the renders."""
    gains: dict[str, float] = {}
    for left_out in held_out:
        trainer = short.trained(left_out.scene, None)
        guidance = setup.on(left_out.scene, short.backend, trainer.plan.guidance)
        first, last = guidance.plan.first_step, guidance.plan.last_step
        steps = [first + (last - first) * level // (NOISE_LEVELS - 1) for level in range(NOISE_LEVELS)]
        gaussians, settings = trainer.model.gaussians, trainer.settings()
        try:
            found = [guidance.repair(step, left_out.view, gaussians, settings) for step in steps]
        except NumericalError as error:
            return Verdict(0.0, f"the prior failed: {error}", [])
        gains[left_out.view.name] = round(sum(found) / NOISE_LEVELS, 4)
    mean = sum(gains.values()) / len(gains)
    trials = [{"view": name, "repair": gain} for name, gain in gains.items()]
    reason = f"its answers are {mean:+.2f} dB closer to left-out views than the renders"
    if mean >= MIN_GAIN:
        return Verdict(1.0, reason, trials)
    return Verdict(0.0, f"{reason}, {MIN_GAIN:g} are asked for", trials)


def _check_guided_runs(short: ShortRun, held_out: list[HeldOutView], setup: GuidanceSetup) -> Verdict:
    """The largest factor on lambda at which guided short runs are no worse than those that are not guided."""
    plain = _mean_psnr(short, held_out, None)
    trials = []
    for factor in FACTORS:
        guided = _mean_psnr(short, held_out, replace(setup, weight=factor * setup.weight))
        trials.append({"factor": factor, "plain": round(plain, 4), "guided": round(guided, 4)})
        if guided >= plain:
            names = ", ".join(left_out.view.name for left_out in held_out)
            return Verdict(factor, f"{guided - plain:+.2f} dB on {names} when left out", trials)
    return Verdict(0.0, "guidance made every left-out view worse, at a quarter of its weight too", trials)


def short_config(config: TrainConfig, scene: Scene, view_conditioned: bool) -> TrainConfig:
    """A small copy of the run: few steps on small images, few Gaussians, no density control, guided as the run is."""
    steps = config.guidance.guard_steps
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    halvings = min(6, max(0, round(math.log2(longest / SHORT_RUN_SIDE))))
    # The method of the run may need the view that is left out; "auto" then takes another one.
    method = "auto" if config.init.method in ("hull", "stereo") else config.init.method
    every = resolved_every(config.guidance, view_conditioned)
    short = replace(
        config,
        init=InitConfig(method, min(SHORT_RUN_GAUSSIANS, config.init.count)),
        density=replace(config.density, refine_start=steps, refine_stop=steps),
        # Downscaled by 2 for every entry that no step passes.
        schedule=ScheduleConfig(coarse_until=tuple(steps + i for i in range(halvings))),
        guidance=replace(config.guidance, every=min(every, max(1, steps // 24)), refresh_every=max(1, steps // 8)),
        checkpoint_every=0,
        preview_every=0,
    )
    return short.with_steps(steps)


def without(scene: Scene, index: int) -> HeldOutView:
    """The scene without one of its input views and that one's mirror images."""
    others = tuple(view for i, view in enumerate(scene.train) if i != index)
    images = tuple(image for image in scene.mirrored if image.index != scene.train[index].index)
    return HeldOutView(replace(scene, train=others, mirrored=images), scene.train[index])


def spread_views(scene: Scene, count: int) -> list[int]:
    """Input views to leave out in turn, far from each other."""
    centers = torch.cat([view.camera.centers for view in scene.train])
    return sorted(farthest_points(centers, min(count, len(scene.train))))


def _mean_psnr(short: ShortRun, held_out: list[HeldOutView], setup: GuidanceSetup | None) -> float:
    """Mean PSNR of the left-out views after short runs on the others, dB."""
    pairs = [short.render(left_out, setup) for left_out in held_out]
    return sum(float(capped_psnr(colors[None], truth[None])) for colors, truth in pairs) / len(held_out)
