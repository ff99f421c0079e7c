"""Every setting of a run: frozen dataclasses, units in docstrings, checked when made, to and from JSON. No torch."""

from __future__ import annotations

import dataclasses
import itertools
import json
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from gsopt import check
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.presets import PRESETS, Preset
from gsopt.errors import InputError, UsageError

T = TypeVar("T")

MOST = 1e9
"""Upper bound of weights and rates: keeps infinities and typing errors out."""
MAX_JSON_NUMBER = 1e300
"""No number of a file reaches it: whole numbers may be longer than a float holds, and sums must not overflow."""
MAX_CONFIG_BYTES = 1 << 20
"""Bytes of config.json that are read."""
MAX_GAUSSIANS = 100_000_000
"""More than any machine this runs on can hold."""

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""Fixed backgrounds, RGB; `random` draws one per step."""


@dataclass(frozen=True)
class DataConfig:
    """Which pixels a run learns from and which it is judged by."""

    path: str = ""
    """Dataset folder: NeRF-synthetic, nerfstudio/instant-ngp or COLMAP."""
    views: int | None = None
    """Learn from this many input views, well spread by camera position; all when not given."""
    view_ids: tuple[int, ...] | None = None
    """Learn from exactly these input views (0-based, in name order)."""
    downscale: int = 1
    """Divide width and height by this (area filter)."""
    eval: bool = False
    """Hold out every 8th image when the dataset has no test split of its own."""
    background: Literal["white", "black", "random"] = "white"
    """Behind transparent pixels. `random` draws a colour per step and evaluates on white."""
    cache_mb: int = 2048
    """Decoded images kept in memory, MB; the rest is read again when needed."""

    @property
    def evaluation_background(self) -> tuple[float, float, float]:
        """Background of renders that are evaluated or displayed: white where training drew random ones."""
        return BACKGROUNDS.get(self.background, BACKGROUNDS["white"])

    def __post_init__(self) -> None:
        check.at_least("--resolution", self.downscale, 1, "1 keeps the size, 2 halves it, and so on.")
        if self.views is not None:
            check.at_least("--views", self.views, 1, "Drop the flag to use all input views.")
        if self.view_ids is not None and (not self.view_ids or min(self.view_ids) < 0):
            raise UsageError(f"`--view-ids` must be numbers from 0 up, got {list(self.view_ids)}. Try 2,16,26.")
        if self.views is not None and self.view_ids is not None:
            raise UsageError("`--views` and `--view-ids` were both given. Keep one of them.")
        check.one_of("--background", self.background, (*BACKGROUNDS, "random"))
        check.at_least("--cache-mb", self.cache_mb, 0, "0 decodes every image again each time; the default is 2048.")


@dataclass(frozen=True)
class InitConfig:
    """The first Gaussians."""

    method: Literal["auto", "points", "hull", "stereo", "random"] = "auto"
    """auto: of few photos without alpha the places on which they agree (stereo), unless as many SfM points are known;
    else SfM points when there are enough, else the visual hull when there is alpha, else random in the frustum."""
    count: int = 20_000
    """How many to make; stereo adds as many at random."""

    def __post_init__(self) -> None:
        check.one_of("--init", self.method, ("auto", "points", "hull", "stereo", "random"))
        check.within("--init-count", self.count, 1, MAX_GAUSSIANS, "The default is 20000.")


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam's learning rates (Kerbl et al. 2023) and its constants."""

    lr_means: float = 1.6e-4
    """Times the scene extent; decays log-linearly to `lr_means_final` over the run."""
    lr_means_final: float = 1.6e-5
    """Times the scene extent; reached at the last step."""
    lr_quats: float = 1e-3
    """Of the rotations."""
    lr_log_scales: float = 1.5e-2
    """Of the logarithms of the scales."""
    lr_logit_opacities: float = 5e-2
    """Of the opacities before the sigmoid."""
    lr_sh0: float = 5e-3
    """Of the base colour."""
    lr_shN: float = 2.5e-4
    """Of the view-dependent colour."""
    lr_last: float = 0.1
    """Share of every rate that is left at the last step: rates fall to it over the last 5 % of a run, but for runs with
    few views. 1 leaves them."""
    beta1: float = 0.9
    """Decay of Adam's mean gradient."""
    beta2: float = 0.999
    """Decay of Adam's mean squared gradient."""
    eps: float = 1e-15
    """Added to the root of the mean squared gradient."""
    sh_degree: int = 3
    """Highest band of the spherical harmonics."""
    sh_degree_every: int = 1000
    """Steps between two bands."""

    def __post_init__(self) -> None:
        for name in ("means", "means_final", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
            value = getattr(self, f"lr_{name}")
            check.within(f"--optimizer.lr-{name}".replace("_", "-"), value, 0.0, MOST, "Drop the flag for the default.")
        check.within("--optimizer.lr-last", self.lr_last, 1e-6, 1.0, "Drop the flag for the default.")
        check.within("--optimizer.beta1", self.beta1, 0.0, 0.999999, "The default is 0.9.")
        check.within("--optimizer.beta2", self.beta2, 0.0, 0.999999, "The default is 0.999.")
        check.within("--optimizer.eps", self.eps, 1e-38, 1.0, "The default is 1e-15.")
        check.within("--optimizer.sh-degree", self.sh_degree, 0, 3, "Bands 0 to 3 are supported.")
        check.at_least("--optimizer.sh-degree-every", self.sh_degree_every, 1, "The default is 1000.")


@dataclass(frozen=True)
class LossConfig:
    """What a step minimises."""

    lambda_dssim: float = 0.2
    """Weight of 1 - SSIM against L1."""
    lambda_alpha: float = 0.0
    """Weight of the L1 between rendered alpha and the image's alpha or mask."""
    lambda_opacity: float | None = None
    """Weight of the mean opacity (Kheradmand et al. 2024); 0.01 with mcmc, 0 with adc when not given."""
    lambda_scale: float | None = None
    """Weight of the mean scale, scene units (Kheradmand et al. 2024); 0.01 with mcmc, 0 with adc when not given."""

    def __post_init__(self) -> None:
        check.within("--loss.lambda-dssim", self.lambda_dssim, 0.0, 1.0, "The default is 0.2.")
        check.within("--loss.lambda-alpha", self.lambda_alpha, 0.0, MOST, "The default is 0.")
        check.within("--loss.lambda-opacity", self.lambda_opacity or 0.0, 0.0, MOST, "Drop it for the default.")
        check.within("--loss.lambda-scale", self.lambda_scale or 0.0, 0.0, MOST, "Drop it for the default.")


@dataclass(frozen=True)
class DensityConfig:
    """How many Gaussians there are, and where."""

    strategy: Literal["adc", "mcmc"] = "adc"
    """adc: clone, split, prune by gradient (Kerbl et al. 2023); mcmc: relocate, grow to budget (Kheradmand 2024)."""
    max_gaussians: int | None = None
    """Never more than this; when not given, what the images show and the length of the run call for."""
    refine_start: int = 500
    """First step after which Gaussians are added and removed."""
    refine_stop: int | None = None
    """Last such step; when not given, min(15000, 60 % of iterations) for adc, min(25000, 83 %) for mcmc."""
    refine_every: int = 100
    """Steps between two refinements."""
    grow_grad2d: float = 2e-4
    """adc: grow where the mean gradient of the projected centre exceeds this (normalised device coordinates)."""
    absgrad: bool = False
    """adc: use absolute gradients (AbsGS); wants a larger grow_grad2d, about 8e-4."""
    grow_scale3d: float = 0.01
    """adc: split above, clone below this scale (fraction of the scene extent)."""
    prune_opacity: float = 0.005
    """adc: remove less opaque ones; mcmc: move less opaque ones to where there is something to draw."""
    prune_scale3d: float = 0.1
    """adc: remove larger ones after the first opacity reset (fraction of the scene extent)."""
    reset_every: int = 3000
    """adc: steps between two opacity resets, none in the last 2000 steps; 0 = never."""
    noise_lr: float = 5e5
    """mcmc: strength of the position noise."""
    growth: float = 1.05
    """mcmc: growth per refinement, until the budget."""

    def __post_init__(self) -> None:
        check.one_of("--strategy", self.strategy, ("adc", "mcmc"))
        if self.max_gaussians is not None:
            check.within("--max-gaussians", self.max_gaussians, 1, MAX_GAUSSIANS, "Drop the flag for the default.")
        check.at_least("--density.refine-start", self.refine_start, 0, "The default is 500.")
        check.at_least("--density.refine-stop", self.refine_stop or 0, 0, "Drop the flag for the default.")
        check.at_least("--density.refine-every", self.refine_every, 1, "The default is 100.")
        check.within("--density.grow-grad2d", self.grow_grad2d, 0.0, MOST, "The default is 0.0002.")
        check.within("--density.grow-scale3d", self.grow_scale3d, 0.0, MOST, "The default is 0.01.")
        check.within("--density.prune-opacity", self.prune_opacity, 1e-6, 0.49, "The default is 0.005.")
        check.within("--density.prune-scale3d", self.prune_scale3d, 0.0, MOST, "The default is 0.1.")
        check.at_least("--density.reset-every", self.reset_every, 0, "0 never resets; the default is 3000.")
        check.within("--density.noise-lr", self.noise_lr, 0.0, MOST, "The default is 500000.")
        check.within("--density.growth", self.growth, 1.0, MOST, "The default is 1.05.")


@dataclass(frozen=True)
class SparseConfig:
    """Regularisers for few views, switched on together at or below `below_views` input views."""

    below_views: int = 16
    """Number of input views from which on down they are active; 0 turns them off."""
    dropout: float = 0.4
    """Share of Gaussians left out of the last step, rising linearly from 0 (DropGaussian, Park et al. 2025)."""
    floater_every: int = 500
    """Steps between two prunings by nearest-neighbour distance (GaussianObject, Yang et al. 2024); 0 = never."""
    lambda_opacity: float = 0.03
    """Replaces the weight of LossConfig where this is larger."""
    lambda_scale: float = 0.01
    """Replaces the weight of LossConfig where this is larger."""
    lambda_alpha: float = 0.5
    """Replaces the weight of LossConfig where this is larger."""
    sh_degree: int = 2
    """Upper bound on the bands."""
    symmetry: Literal["auto", "off"] = "auto"
    """Look for the mirror planes of an object with masks, and learn from the mirror images of its photos too."""
    steps_per_view: int = 500
    """A run takes at most this many steps per input view: more learn few views by heart; 0 = no bound."""

    def __post_init__(self) -> None:
        check.at_least("--sparse.below-views", self.below_views, 0, "0 turns these regularisers off.")
        check.within("--sparse.dropout", self.dropout, 0.0, 0.95, "0 leaves none out; the default is 0.4.")
        check.at_least("--sparse.floater-every", self.floater_every, 0, "0 never prunes; the default is 500.")
        check.within("--sparse.lambda-opacity", self.lambda_opacity, 0.0, MOST, "The default is 0.03.")
        check.within("--sparse.lambda-scale", self.lambda_scale, 0.0, MOST, "The default is 0.01.")
        check.within("--sparse.lambda-alpha", self.lambda_alpha, 0.0, MOST, "The default is 0.5.")
        check.one_of("--sparse.symmetry", self.symmetry, ("auto", "off"))
        check.within("--sparse.sh-degree", self.sh_degree, 0, 3, "Bands 0 to 3 are supported.")
        check.at_least("--sparse.steps-per-view", self.steps_per_view, 0, "0 sets no bound; the default is 500.")


@dataclass(frozen=True)
class ScheduleConfig:
    """Skip what a step does not need."""

    coarse_until: tuple[int, ...] | None = None
    """Steps at which the resolution doubles, e.g. 500 1500: quarter, half, full. When not given, shares of the run
    (training/plan.py); the flag without a step means full resolution throughout."""
    stop_when_flat: bool = False
    """Stop early when the loss over the input views no longer falls (criterion: training/schedule.py)."""
    crop_masked: bool = False
    """Draw only where a masked image shows something, the whole image every 8th step (training/content_window.py)."""
    rest_converged: bool = False
    """After the last refinement, leave out every other visit of a view whose loss no longer falls."""
    bands: Literal["steps", "residual"] = "steps"
    """Draw one more band of the spherical harmonics every `sh_degree_every` steps, or only then and where the residual
    depends on the view (training/skipping.py)."""

    def __post_init__(self) -> None:
        given = self.coarse_until or ()
        steps = (0, *given)
        if any(later <= earlier for earlier, later in itertools.pairwise(steps)):
            raise UsageError(
                f"`--schedule.coarse-until` must be rising steps above 0, got {list(given)}. Try 500 1500."
            )
        check.within("number of --schedule.coarse-until", len(given), 0, 6, "Each one halves the image.")
        check.one_of("--schedule.bands", self.bands, ("steps", "residual"))


@dataclass(frozen=True)
class PoseConfig:
    """Correct the poses of the input views while learning."""

    refine: bool = False
    """Learn a small rigid motion for every input view; held-out views stay where they are."""
    lr: float = 1e-3
    """How far a step shifts the picture of the view it draws, radians, at first."""
    lr_final: float = 1e-5
    """The same at the last step; log-linear in between."""
    start: int = 500
    """Poses stay as given for this many steps: there must be something to align with."""

    def __post_init__(self) -> None:
        check.within("--poses.lr", self.lr, 1e-9, 0.1, "The default is 0.001.")
        check.within("--poses.lr-final", self.lr_final, 1e-9, 0.1, "The default is 0.00001.")
        check.at_least("--poses.start", self.start, 0, "The default is 500.")


@dataclass(frozen=True)
class TrainConfig:
    """One run, complete: with the data and the same version of gsopt it gives the same bits again."""

    data: DataConfig = field(default_factory=DataConfig)
    init: InitConfig = field(default_factory=InitConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    sparse: SparseConfig = field(default_factory=SparseConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    poses: PoseConfig = field(default_factory=PoseConfig)
    preset: Preset = "default"
    """Where the settings came from that no flag named (gsopt/config/presets.py)."""
    iterations: int = 7000
    """Steps; with few views no more than `sparse.steps_per_view` for each."""
    seed: int = 0
    backend: Literal["auto", "cpu", "reference"] = "auto"
    threads: int = 0
    """0 = one per core. The result does not depend on it."""
    antialiased: bool = False
    """Mip-Splatting's 2D filter."""
    checkpoint_every: int = 1000
    """Steps between two checkpoints; 0 = only at the end."""
    preview_every: int = 500
    """Steps between two preview PLYs; 0 = none."""

    def __post_init__(self) -> None:
        check.one_of("--preset", self.preset, tuple(PRESETS))
        check.at_least("--iterations", self.iterations, 1, "Drop the flag for the default of 7000.")
        check.at_least("--threads", self.threads, 0, "0 takes one thread per core.")
        check.within("--seed", self.seed, 0, 2**31 - 1, "Give a whole number in that range.")
        check.one_of("--backend", self.backend, ("auto", "cpu", "reference"))
        check.at_least("--checkpoint-every", self.checkpoint_every, 0, "0 writes only the last one.")
        check.at_least("--preview-every", self.preview_every, 0, "0 writes none.")

    def with_steps(self, steps: int) -> TrainConfig:
        """The same with exactly so many steps, however few the views."""
        sparse = dataclasses.replace(self.sparse, steps_per_view=0)
        return dataclasses.replace(self, iterations=steps, sparse=sparse)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; `from_dict` is its inverse."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @staticmethod
    def from_dict(values: dict[str, Any]) -> TrainConfig:
        """Build from parsed JSON. Unknown keys and wrong types raise InputError that names them."""
        return _build(TrainConfig, values, "config")

    @staticmethod
    def read(path: Path) -> TrainConfig:
        """The `config` of a run's config.json."""
        try:
            with open(path, "rb") as file:
                document = json.loads(file.read(MAX_CONFIG_BYTES))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(
                f"Cannot read the configuration {path}: {error}. Give the folder of a gsopt run."
            ) from error
        if not isinstance(document, dict) or not isinstance(document.get("config"), dict):
            raise InputError(f"{path} has no object `config`. Give the config.json that `gsopt train` wrote.")
        return TrainConfig.from_dict(document["config"])


def _build(cls: type[T], values: object, where: str) -> T:
    if not isinstance(values, dict):
        raise InputError(f"`{where}` must be an object, got {type(values).__name__}. See `gsopt train --help`.")
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise InputError(f"Unknown key `{where}.{unknown[0]}`. Known keys: {', '.join(hints)}.")
    return cls(**{key: _convert(hints[key], value, f"{where}.{key}") for key, value in values.items()})


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where)  # type: ignore[arg-type]
    if _matches(hint, value):
        return tuple(value) if isinstance(value, list) else value
    name = getattr(hint, "__name__", str(hint))
    raise InputError(f"`{where}` must be {name}, got {value!r}. Correct it or remove the key for the default.")


def _matches(hint: Any, value: Any) -> bool:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in args
    if origin in (types.UnionType, typing.Union):
        return any(_matches(arg, value) for arg in args)
    if origin is tuple:
        return isinstance(value, (list, tuple)) and all(_matches(args[0], item) for item in value)
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < MAX_JSON_NUMBER
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return value is None if hint is type(None) else isinstance(value, hint)
