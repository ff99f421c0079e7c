"""`RunPlan`: the settings of a run, resolved once against its scene. Nothing in it is left open."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from gsopt.config.cells import CellConfig
from gsopt.config.train import (
    DensityConfig,
    ExposureConfig,
    InitConfig,
    PoseConfig,
    TrainConfig,
)
from gsopt.data.background import Background
from gsopt.data.scene import Scene
from gsopt.geometry.focus import find_focus
from gsopt.sds.guidance_plan import GuidancePlans
from gsopt.sds.select_prior import PriorSelection, select_prior
from gsopt.training.open_settings import OpenSettings, is_sparse, open_settings
from gsopt.training.schedule import Schedule
from gsopt.training.targets import content_pixels

# Published end of refinement (Kerbl et al. 2023; Kheradmand et al. 2024), and its share of a shorter run.
REFINE_STOP = {"adc": (15_000, 0.6), "mcmc": (25_000, 0.83)}
# Pixels of all views together that a Gaussian of a longer run must have: its 59 numbers learn from three of each.
PIXELS_PER_GAUSSIAN = 30
MIN_BUDGET, MAX_BUDGET = 20_000, 1_000_000
# Mirror images drawn per epoch, times the number of photos: the more photos there are, the less they leave open and the
# more the images blur what the photos show (docs/decisions/0002-symmetry.md).
MIRRORED_TIMES_VIEWS = 32
# Share of SparseConfig's lambda_opacity without masks: in a scene nothing is transparent, and faded splats are haze.
OPAQUE_SHARE = 1 / 3
# Distance to a camera below which gradients are weakened, over the distance to what the cameras look at.
NEAR_SHARE = 1.5
# The same share, below which what is faint is haze (docs/decisions/0031-haze.md).
HAZE_SHARE = 0.25
# Photos up to which the depths on which they agree are a target, and the share of the run in which they are: true to
# some percent, they put Gaussians where colors alone would not, and then colors know better (0042).
MAX_MATCHED, MATCHED_SHARE = 12, 1 / 3
# Most memory for float targets, as a share of the decoded images': both hold the same views.
TARGET_CACHE_SHARE = 0.5


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the training loss."""

    dssim: float
    alpha: float
    opacity: float
    scale: float
    area: float
    depth: float
    """1 - the correlation with the inverse depths of `--depth`."""
    agreed: float
    """The error of the inverse depths on which few photos of a whole scene agree."""
    unseen: float
    """The term on views between few photos of an object with masks."""


@dataclass(frozen=True)
class DensityPlan:
    """`DensityConfig` with nothing left open, but for the steps, which `Schedule` has."""

    strategy: str
    max_gaussians: int
    grow_grad2d: float
    absgrad: bool
    prune_opacity: float
    prune_scale: float
    """adc: remove larger ones after the first opacity reset, scene units."""
    turnover: float
    """adc: share that adds least to the input views, removed now and then; 0 = never."""
    noise_lr: float
    growth: float


@dataclass(frozen=True)
class RunPlan:
    """One run on one scene."""

    seed: int
    sparse: bool
    """True when the regularizers for few views are on."""
    opaque: bool
    """True with few views of a whole scene, no masks: then the Gaussians of the last steps are averaged."""
    near_distance: float
    """Distance to a camera below which gradients are weakened, scene units; 0 = never."""
    haze_distance: float
    """Distance to a camera below which what is faint is removed, scene units; 0 = never."""
    background: Background
    antialiased: bool
    init: InitConfig
    cell: CellConfig
    weights: LossWeights
    schedule: Schedule
    density: DensityPlan
    poses: PoseConfig
    exposure: ExposureConfig
    prior: PriorSelection
    guidance: GuidancePlans
    extra_per_epoch: int
    """Number of mirror images or guessed views drawn beside every input view once."""
    target_cache_mb: float
    stop_when_flat: bool
    crop_masked: bool
    rest_converged: bool
    residual_bands: bool
    """True when a band is drawn only where the residual depends on the view."""
    checkpoint_every: int
    preview_every: int

    @staticmethod
    def of(config: TrainConfig, scene: Scene) -> RunPlan:
        """Resolves the settings against a scene, mirror images included."""
        views = len(scene.train)
        settings = open_settings(config.sparse, views, masked=scene.has_alpha)
        sparse = settings.few
        iterations = shortened(config, settings, 2 * views if scene.completed else views)
        background, focus = Background.of(config.data, scene), focus_distance(scene)
        pixels = content_pixels(scene.train)
        budget = config.density.max_gaussians or default_budget(pixels, views, iterations, settings.gaussians_per_pixel)
        schedule = make_schedule(config, iterations, settings, scene.extent, pixels)
        return RunPlan(
            seed=config.seed,
            sparse=sparse,
            opaque=sparse and not scene.has_alpha,
            near_distance=NEAR_SHARE * focus if sparse else 0.0,
            haze_distance=HAZE_SHARE * focus,
            background=background,
            antialiased=config.antialiased,
            init=config.init,
            cell=config.cell,
            weights=loss_weights(config, sparse, scene.has_alpha, scene.extent, matches_photos(config, scene)),
            schedule=schedule,
            density=density_plan(config.density, budget, settings, scene.extent),
            poses=config.poses,
            exposure=config.exposure,
            prior=select_prior(config.guidance, completed=scene.body is not None),
            guidance=GuidancePlans.of(config.guidance, iterations, config.seed, background),
            extra_per_epoch=extra_per_epoch(scene),
            target_cache_mb=TARGET_CACHE_SHARE * config.data.cache_mb,
            stop_when_flat=config.schedule.stop_when_flat,
            crop_masked=config.schedule.crop_masked,
            rest_converged=config.schedule.rest_converged,
            residual_bands=config.schedule.bands == "residual",
            checkpoint_every=config.checkpoint_every,
            preview_every=config.preview_every,
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, for config.json."""
        return json.loads(json.dumps(asdict(self)))


def focus_distance(scene: Scene) -> float:
    """The cameras' distance to what they all look at; 0 where they look at no one place, and where masks keep haze
    away."""
    focus = find_focus([view.camera for view in scene.train], scene.extent)
    return focus.distance if focus.converging and not scene.has_alpha else 0.0


def guesses(config: TrainConfig, views: int) -> bool:
    """True when a single photo is completed by views of the body that it suggests."""
    return config.sparse.inflate == "auto" and is_sparse(config.sparse, views) and not config.poses.refine


def matches_photos(config: TrainConfig, scene: Scene) -> bool:
    """True when a run learns from the depths on which its photos agree: few photos of a whole scene."""
    few = 1 < len(scene.train) <= MAX_MATCHED and is_sparse(config.sparse, len(scene.train))
    return few and not scene.has_alpha and config.loss.lambda_depth > 0 and config.data.depth is None


def shortened(config: TrainConfig, settings: OpenSettings, views: int) -> int:
    """The number of steps, no more than few views can use."""
    per_view = settings.of(config.sparse)["steps_per_view"]
    if per_view == 0 or not settings.few:
        return config.iterations
    return min(config.iterations, per_view * views)


def make_schedule(
    config: TrainConfig, iterations: int, settings: OpenSettings, extent: float, pixels: float
) -> Schedule:
    """The schedule of a run of so many steps, whose images have so many pixels that show something.

    Few views cannot tell view dependence from shape, so that they get fewer bands.
    """
    density, optimizer, few = settings.growth(config.density), settings.of(config.optimizer), settings.few
    degree = config.optimizer.sh_degree
    return Schedule(
        iterations=iterations,
        extent=extent,
        optimizer=replace(config.optimizer, **optimizer),
        lr_means_first=optimizer["lr_means"],
        sh_degree_every=optimizer["sh_degree_every"],
        settling=math.ceil(settings.settling_share * iterations),
        coarse_until=coarse_until(config.schedule.coarse_until, settings, iterations, pixels),
        agreed_until=round(MATCHED_SHARE * iterations),
        max_sh_degree=min(degree, config.sparse.sh_degree) if few else degree,
        refine_start=density["refine_start"],
        refine_stop=refine_stop(config.density, iterations),
        refine_every=density["refine_every"],
        reset_every=config.density.reset_every,
        max_dropout=settings.of(config.sparse)["dropout"] if few else 0.0,
        most_dropout_at=math.floor(settings.most_dropout_share * iterations),
        floater_every=config.sparse.floater_every if few else 0,
        haze_every=config.density.haze_every,
    )


def coarse_until(
    given: tuple[int, ...] | None, settings: OpenSettings, iterations: int, pixels: float
) -> tuple[int, ...]:
    """Last steps at a quarter and at half of the resolution, as given or as shares of the run, without those whose
    images would show too little."""
    if given is not None:
        return given
    halved = zip(range(len(settings.coarse_shares), 0, -1), settings.coarse_shares, strict=True)
    shares = [share for times, share in halved if pixels / 4**times >= settings.least_content]
    return tuple(step for step in (round(share * iterations) for share in shares) if step > 0)


def refine_stop(config: DensityConfig, iterations: int) -> int:
    """Last step after which Gaussians may be added or removed."""
    if config.refine_stop is not None:
        return config.refine_stop
    published, share = REFINE_STOP[config.strategy]
    return min(published, round(share * iterations))


def loss_weights(
    config: TrainConfig, sparse: bool, has_alpha: bool, extent: float, matched: bool = False
) -> LossWeights:
    """The run's weights: LossConfig's (0.01 for mcmc's two, Kheradmand et al. 2024), or SparseConfig's if larger.

    Large splats are weighed by their area on an object with masks (docs/decisions/0030-area.md), and not in a scene,
    whose background needs some (docs/decisions/0043-opaque-scenes.md)."""
    loss, few = config.loss, config.sparse
    default = 0.01 if config.density.strategy == "mcmc" else 0.0
    alpha = loss.lambda_alpha
    opacity = default if loss.lambda_opacity is None else loss.lambda_opacity
    scale = default if loss.lambda_scale is None else loss.lambda_scale
    if not sparse:
        return LossWeights(loss.lambda_dssim, alpha, opacity, scale, 0.0, loss.lambda_depth, agreed=0.0, unseen=0.0)
    alpha = max(alpha, few.lambda_alpha)
    if has_alpha:
        opacity, area = max(opacity, few.lambda_opacity), few.lambda_area / extent**2
    else:
        opacity, area = max(opacity, OPAQUE_SHARE * few.lambda_opacity), 0.0
    depth, agreed = (0.0, loss.lambda_depth) if matched else (loss.lambda_depth, 0.0)
    return LossWeights(loss.lambda_dssim, alpha, opacity, scale, area, depth, agreed, few.lambda_unseen)


def density_plan(config: DensityConfig, budget: int, settings: OpenSettings, extent: float) -> DensityPlan:
    """The parameters of density control; lengths in scene units."""
    growth = settings.growth(config)
    return DensityPlan(
        strategy=config.strategy,
        max_gaussians=budget,
        grow_grad2d=growth["grow_grad2d"],
        absgrad=config.absgrad,
        prune_opacity=config.prune_opacity,
        prune_scale=config.prune_scale3d * extent,
        turnover=growth["turnover"] if config.strategy == "adc" else 0.0,
        noise_lr=config.noise_lr,
        growth=config.growth,
    )


def default_budget(pixels: float, views: int, iterations: int, per_pixel: float) -> int:
    """Number of Gaussians that `views` images, each with so many `pixels` that show something, can use in a run this
    long: in 7000 steps `per_pixel` for each, and more only where the views tell enough, else they learn the views by
    heart."""
    longer = min(iterations / 7000, max(1, views / (per_pixel * PIXELS_PER_GAUSSIAN)))
    wanted = round(per_pixel * pixels * max(longer, math.sqrt(longer)))
    return min(max(wanted, MIN_BUDGET), MAX_BUDGET)


def extra_per_epoch(scene: Scene) -> int:
    """Number of mirror images or guessed views drawn beside every input view once: one beside a single photo."""
    views = len(scene.train)
    return views if scene.completed else min(len(scene.mirrored), round(MIRRORED_TIMES_VIEWS / views))
