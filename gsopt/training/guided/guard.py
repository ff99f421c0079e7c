"""The guard: short runs without one input view say whether guidance helps there, before the run itself is guided.

A view the model has learned from cannot tell: any prior only blurs what is known. So every view that is left out gets a
model that never saw it, first Gaussians included.

A view-conditioned prior is asked what that model's render should look like: only one whose answers are closer to the
left-out views, by REPAIR at least, guides the run. What a run gains follows from that (docs/howto/guidance.md).

Of a text-to-image prior single answers tell little. There a second model is guided, the same in all else. Where that
lowers the mean PSNR of the left-out views, lambda is halved and tried again; after three trials it is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.guidance import settled
from gsopt.config.train import InitConfig, ScheduleConfig, TrainConfig
from gsopt.data.scene import Scene, View
from gsopt.data.split import farthest_points
from gsopt.errors import NumericalError
from gsopt.events import Report
from gsopt.geometry.cameras import Cameras
from gsopt.init import first_gaussians
from gsopt.metrics import capped_psnr
from gsopt.raster.backend import Backend
from gsopt.sds import schedule as sds_schedule
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.priors.protocol import Prior
from gsopt.training import schedule
from gsopt.training.guided.session import RunGuidance, make_guide
from gsopt.training.targets import Targets
from gsopt.training.trainer import Trainer

REPAIR = 0.5
"""dB. Fits with a view less are easier to repair than the run's own: by this much, a prior that knows nothing more may
seem to help."""
LOOKS = 4
"""Noise levels at which a prior is asked about each left-out view, those of the guided steps."""
FACTORS = (1.0, 0.5, 0.25)
SIDE = 128
"""Longer side of the images of a short run, px, as near as halving comes."""
GAUSSIANS = 5000
WHITE = torch.ones(3)
Aid = tuple[Prior, Conditioning, float, Cameras, Report]
"""What guides a short run: `make_guide`'s last arguments."""


@dataclass(frozen=True)
class Verdict:
    """What the guard found."""

    factor: float
    """On lambda."""
    reason: str
    trials: list[dict[str, Any]]
    """Per left-out view: its name and by how many dB it was repaired. Or, of a text-to-image prior, per trial: factor,
    and mean PSNR of the left-out views with and without guidance, dB."""


@dataclass(frozen=True)
class HeldOutView:
    """One input view left out."""

    scene: Scene
    """Without it."""
    view: View


def evaluate_guidance(
    config: TrainConfig,
    scene: Scene,
    backend: Backend,
    prior: Prior,
    conditioning: Conditioning,
    weight: float,
    front: Cameras,
    warn: Report,
) -> Verdict:
    """How much of `weight` the run should have, going by input views that were left out."""
    guidance = config.guidance
    if guidance.guard_views == 0:
        return Verdict(1.0, "not checked: --guidance.guard-views is 0", [])
    if len(scene.train) < 2:
        only = "one input view cannot say whether it helps"
        return Verdict(0.0, f"off: {only}", []) if prior.aligned else Verdict(1.0, f"not checked: {only}", [])
    short = short_config(config, scene, prior.aligned)
    lefts = [without(scene, index) for index in spread_views(scene, guidance.guard_views)]
    aid = prior, conditioning, weight, front, warn
    return _repairs(short, lefts, backend, aid) if prior.aligned else _helps(short, lefts, backend, aid)


def _repairs(config: TrainConfig, lefts: list[HeldOutView], backend: Backend, aid: Aid) -> Verdict:
    """Whether the prior's answers are closer to the left-out views than what it is shown."""
    first, last = (of(config.guidance, config.iterations) for of in (sds_schedule.first_step, sds_schedule.last_step))
    steps = [first + (last - first) * look // (LOOKS - 1) for look in range(LOOKS)]
    repairs: dict[str, float] = {}
    for left in lefts:
        trainer = _trained(config, left, backend, None)
        guide, gaussians = make_guide(config, left.scene, backend, *aid), trainer.model.gaussians
        try:
            found = [guide.repair(step, left.view, gaussians, trainer.settings()) for step in steps]
        except NumericalError as error:
            return Verdict(0.0, f"the prior failed: {error}", [])
        repairs[left.view.name] = round(sum(found) / LOOKS, 4)
    mean = sum(repairs.values()) / len(repairs)
    trials = [{"view": name, "repair": repair} for name, repair in repairs.items()]
    said = f"its answers are {mean:+.2f} dB closer to left-out views than the renders"
    return Verdict(1.0, said, trials) if mean >= REPAIR else Verdict(0.0, f"{said}, {REPAIR:g} are asked for", trials)


def _helps(config: TrainConfig, lefts: list[HeldOutView], backend: Backend, aid: Aid) -> Verdict:
    """The largest factor on lambda at which a guided short run is no worse than one that is not."""
    prior, conditioning, weight, front, warn = aid
    plain = sum(_psnr(config, left, backend, None) for left in lefts) / len(lefts)
    trials = []
    for factor in FACTORS:
        made = [_psnr(config, left, backend, (prior, conditioning, factor * weight, front, warn)) for left in lefts]
        guided = sum(made) / len(lefts)
        trials.append({"factor": factor, "plain": round(plain, 4), "guided": round(guided, 4)})
        if guided >= plain:
            names = ", ".join(left.view.name for left in lefts)
            return Verdict(factor, f"{guided - plain:+.2f} dB on {names} when left out", trials)
    return Verdict(0.0, "guidance made every left-out view worse, at a quarter of its weight too", trials)


def short_config(config: TrainConfig, scene: Scene, view_conditioned: bool) -> TrainConfig:
    """A small copy of the run: few steps on small images, few Gaussians, no density control, guided as the run is."""
    steps = config.guidance.guard_steps
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    halvings = min(6, max(0, round(math.log2(longest / SIDE))))
    # What was asked for may not fit with a view less, where "auto" then takes something else.
    method = "auto" if config.init.method in ("hull", "stereo") else config.init.method
    guidance = settled(config.guidance, view_conditioned)
    guidance = replace(guidance, every=min(guidance.every or 1, max(1, steps // 24)), refresh_every=max(1, steps // 8))
    return replace(
        config,
        iterations=steps,
        init=InitConfig(method, min(GAUSSIANS, config.init.count)),
        density=replace(config.density, refine_start=steps, refine_stop=steps),
        # Downscaled by 2 for every entry that no step passes.
        schedule=ScheduleConfig(coarse_until=tuple(steps + i for i in range(halvings))),
        guidance=guidance,
        checkpoint_every=0,
        preview_every=0,
    )


def without(scene: Scene, index: int) -> HeldOutView:
    """The scene without one of its input views and that one's mirror images."""
    others = tuple(view for i, view in enumerate(scene.train) if i != index)
    images = tuple(image for image in scene.mirrored if image.index != scene.train[index].index)
    return HeldOutView(replace(scene, train=others, mirrored=images), scene.train[index])


def spread_views(scene: Scene, count: int) -> list[int]:
    """Input views to leave out in turn, far from each other."""
    centers = torch.cat([view.camera.centers for view in scene.train])
    return sorted(farthest_points(centers, min(count, len(scene.train))))


def short_run(
    config: TrainConfig, left: HeldOutView, backend: Backend, guide: Aid | None
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
    """The left-out view after a short run on the others, 0..1 on white, and how it really looks."""
    trainer = _trained(config, left, backend, guide)
    target = Targets([left.view], WHITE, 0).get(0, schedule.downscale(1, config.schedule.coarse_until or ()), WHITE)
    colors = backend.forward(trainer.model.gaussians, target.camera, trainer.settings(), WHITE).colors
    return colors.clamp(0, 1), target.colors


def _trained(config: TrainConfig, left: HeldOutView, backend: Backend, guide: Aid | None) -> Trainer:
    """A short run at its end."""
    degree = schedule.max_sh_degree(config, len(left.scene.train))
    gaussians, _ = first_gaussians(left.scene, config.init, degree, config.seed)
    guidance = None if guide is None else RunGuidance(make_guide(config, left.scene, backend, *guide))
    trainer = Trainer(config, left.scene, gaussians, backend, guidance)
    while trainer.step < config.iterations:
        trainer.advance()
    return trainer


def _psnr(config: TrainConfig, left: HeldOutView, backend: Backend, guide: Aid | None) -> float:
    """Of the left-out view after a short run on the others, dB."""
    colors, truth = short_run(config, left, backend, guide)
    return float(capped_psnr(colors[None], truth[None]))
