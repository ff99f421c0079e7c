"""Compares sets of prompts on a scene: a short guided run for each, measured on an input view that it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import UsageError
from gsopt.events import Report
from gsopt.metrics import capped_psnr
from gsopt.raster.backend import Backend
from gsopt.sds.guidance_step import GuidanceSetup
from gsopt.sds.priors.protocol import Prior
from gsopt.sds.prompts import Prompt
from gsopt.training.guided.guard import ShortRun, short_config, spread_views, without
from gsopt.training.guided.references import encoded, front_camera, read_references
from gsopt.training.mirror_images import with_mirrors


@dataclass(frozen=True)
class Arm:
    """One set of prompts."""

    name: str
    prompts: tuple[Prompt, ...]
    references: tuple[str, ...] = ()
    """Accepted reference images, as paths."""
    weight: float = 0.2
    """lambda_sds; 0 for no guidance at all."""


@dataclass(frozen=True)
class Outcome:
    """Result of an arm."""

    arm: Arm
    psnrs: tuple[float, ...]
    """Per left-out view, dB."""
    pictures: tuple[Float[Tensor, "H W 3"], ...]
    """The left-out views as this arm draws them."""
    alignment: float | None
    """Mean CLIP score of its positive prompts, None where nothing measures it."""

    @property
    def mean(self) -> float:
        return sum(self.psnrs) / len(self.psnrs)


@dataclass(frozen=True)
class Comparison:
    """All arms on the same left-out views."""

    views: tuple[str, ...]
    truths: tuple[Float[Tensor, "H W 3"], ...]
    outcomes: tuple[Outcome, ...]


@torch.no_grad()
def compare_prompts(
    config: TrainConfig, scene: Scene, backend: Backend, prior: Prior, arms: Sequence[Arm], report: Report
) -> Comparison:
    """Every arm on every left-out view, the same in all else; `config.guidance` says how many and how long.

    Raises UsageError for a scene of one view and for a prior that takes no words.
    """
    if len(scene.train) < 2:
        raise UsageError("Comparing needs at least 2 input views, got 1: one is left out. Give more views.")
    if prior.encoder() is None and any(arm.prompts for arm in arms):
        raise UsageError(
            f"The prior {prior.name} takes no words: every set of prompts would give the same. Name a Stable Diffusion "
            "model with --prior sd21 or a diffusers folder."
        )
    scene = with_mirrors(config, scene)
    short = ShortRun(short_config(config, scene, prior.aligned), backend)
    held_out = [without(scene, index) for index in spread_views(scene, max(1, config.guidance.guard_views))]
    truths: list[Tensor] = []
    outcomes = []
    for arm in arms:
        drawn, scores = [], []
        for left_out in held_out:
            setup = None if arm.weight == 0 else _setup(config.guidance, left_out.scene, prior, arm, report)
            picture, truth = short.render(left_out, setup)
            drawn.append(picture)
            truths += [truth] if len(truths) < len(held_out) else []
            scores += [] if setup is None else [p.score for p in setup.conditioning.prompts if p.score is not None]
        psnrs = tuple(
            float(capped_psnr(picture[None], truth[None])) for picture, truth in zip(drawn, truths, strict=True)
        )
        outcomes.append(Outcome(arm, psnrs, tuple(drawn), sum(scores) / len(scores) if scores else None))
        report(f"{arm.name}: {outcomes[-1].mean:.2f} dB on {len(held_out)} left-out views")
    return Comparison(tuple(left_out.view.name for left_out in held_out), tuple(truths), tuple(outcomes))


def _setup(config: GuidanceConfig, scene: Scene, prior: Prior, arm: Arm, report: Report) -> GuidanceSetup:
    """The arm's prompts and reference images, encoded without the view that is left out."""
    references = read_references(arm.references, prior.size)
    conditioning = encoded(config.image_weight, scene, prior, arm.prompts, references)
    return GuidanceSetup(prior, conditioning, front_camera(config, scene), arm.weight, report)
