"""Which prompts help on this scene: short guided runs, one per set, each judged by an input view it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import UsageError
from gsopt.events import Report
from gsopt.llm_prompts.schema import Prompt
from gsopt.metrics import capped_psnr
from gsopt.raster.backend import Backend
from gsopt.sds.candidate_views import square_views
from gsopt.sds.conditioning import Conditioning, encode
from gsopt.sds.priors.protocol import Prior
from gsopt.training.guided.guard import WHITE, HeldOutView, short_config, short_run, spread_views, without
from gsopt.training.guided.session import EMBEDDED_INPUTS, front_camera, read_references
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
    """How an arm did."""

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
    short = short_config(config, scene, prior.aligned)
    lefts = [without(scene, index) for index in spread_views(scene, max(1, config.guidance.guard_views))]
    truths: list[Tensor] = []
    outcomes = []
    for arm in arms:
        drawn, scores = [], []
        for left in lefts:
            known = None if arm.weight == 0 else _conditioning(short, left, prior, arm)
            front = front_camera(config, left.scene)
            aid = None if known is None else (prior, known, arm.weight, front, report)
            picture, truth = short_run(short, left, backend, aid)
            drawn.append(picture)
            truths += [truth] if len(truths) < len(lefts) else []
            scores += [] if known is None else [p.score for p in known.prompts if p.score is not None]
        psnrs = tuple(
            float(capped_psnr(picture[None], truth[None])) for picture, truth in zip(drawn, truths, strict=True)
        )
        outcomes.append(Outcome(arm, psnrs, tuple(drawn), sum(scores) / len(scores) if scores else None))
        report(f"{arm.name}: {outcomes[-1].mean:.2f} dB on {len(lefts)} left-out views")
    return Comparison(tuple(left.view.name for left in lefts), tuple(truths), tuple(outcomes))


def _conditioning(config: TrainConfig, left: HeldOutView, prior: Prior, arm: Arm) -> Conditioning:
    """The arm's words and pictures, encoded without the view that is left out."""
    views = left.scene.train
    inputs = square_views(views[:: max(1, -(-len(views) // EMBEDDED_INPUTS))], prior.size, WHITE).images
    references = read_references(arm.references, prior.size)
    weight = config.guidance.image_weight
    return encode(prior.encoder(), arm.prompts, inputs, references, weight, prior.class_embedding_width)
