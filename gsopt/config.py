"""Every setting of a run: frozen dataclasses with units in the docstrings, checked when made, to and from JSON. No torch here."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from gsopt import check
from gsopt.errors import InputError, UsageError

T = TypeVar("T")


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

    def __post_init__(self) -> None:
        check.at_least("--resolution", self.downscale, 1, "1 keeps the size, 2 halves it, and so on.")
        if self.views is not None:
            check.at_least("--views", self.views, 1, "Drop the flag to use all input views.")
        if self.views is not None and self.view_ids is not None:
            raise UsageError("`--views` and `--view-ids` were both given. Keep one of them.")
        check.one_of("--background", self.background, ("white", "black", "random"))


@dataclass(frozen=True)
class InitConfig:
    """The first Gaussians."""

    method: Literal["auto", "points", "hull", "random"] = "auto"
    """auto: SfM points when there are enough, else the visual hull when there is alpha, else random in the common frustum."""
    count: int = 20_000
    """How many to make (hull and random)."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam's learning rates (Kerbl et al. 2023) and its constants."""

    lr_means: float = 1.6e-4
    """Times the scene extent; decays log-linearly to `lr_means_final` over the run."""
    lr_means_final: float = 1.6e-6
    lr_quats: float = 1e-3
    lr_log_scales: float = 5e-3
    lr_logit_opacities: float = 5e-2
    lr_sh0: float = 2.5e-3
    lr_shN: float = 1.25e-4
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    sh_degree: int = 3
    """Highest band of the spherical harmonics."""
    sh_degree_every: int = 1000
    """Steps between two bands."""


@dataclass(frozen=True)
class LossConfig:
    """What a step minimises."""

    lambda_dssim: float = 0.2
    """Weight of 1 - SSIM against L1."""
    lambda_alpha: float = 0.0
    """Weight of the L1 between rendered alpha and the image's alpha or mask."""
    lambda_opacity: float = 0.0
    """Weight of the mean opacity (Kheradmand et al. 2024)."""
    lambda_scale: float = 0.0
    """Weight of the mean scale, scene units (Kheradmand et al. 2024)."""


@dataclass(frozen=True)
class DensityConfig:
    """How many Gaussians there are, and where."""

    strategy: Literal["adc", "mcmc"] = "adc"
    """adc: clone, split, prune by gradient (Kerbl et al. 2023); mcmc: relocate and grow to the budget (Kheradmand et al. 2024)."""
    max_gaussians: int = 1_000_000
    """Never more than this."""
    refine_start: int = 500
    refine_stop: int = 15_000
    """Steps between which Gaussians are added and removed; never past half of `iterations` for adc's growth."""
    refine_every: int = 100
    grow_grad2d: float = 2e-4
    """adc: grow where the mean gradient of the projected centre exceeds this (normalised device coordinates)."""
    absgrad: bool = False
    """adc: use absolute gradients (AbsGS); wants a larger grow_grad2d, about 8e-4."""
    grow_scale3d: float = 0.01
    """adc: split above, clone below this scale (fraction of the scene extent)."""
    prune_opacity: float = 0.005
    prune_scale3d: float = 0.1
    """adc: remove larger ones after the first opacity reset (fraction of the scene extent)."""
    reset_every: int = 3000
    """adc: steps between two opacity resets."""
    noise_lr: float = 5e5
    """mcmc: strength of the position noise."""
    growth: float = 1.05
    """mcmc: growth per refinement, until the budget."""


@dataclass(frozen=True)
class SparseConfig:
    """Regularisers for few views (see docs/decisions); switched on together at or below `below_views` input views."""

    below_views: int = 16
    """Number of input views from which on down they are active; 0 turns them off."""
    dropout: float = 0.2
    """Share of Gaussians left out of a step at the end of the run, rising linearly from 0 (DropGaussian, Park et al. 2025)."""
    floater_every: int = 500
    """Steps between two prunings by nearest-neighbour distance (GaussianObject, Yang et al. 2024); 0 = never."""
    lambda_opacity: float = 0.01
    lambda_scale: float = 0.01
    lambda_alpha: float = 0.1
    """Replace those of LossConfig where these are larger."""
    sh_degree: int = 2
    """Upper bound on the bands."""


@dataclass(frozen=True)
class ScheduleConfig:
    """Skip what a step does not need."""

    coarse_until: tuple[int, ...] = ()
    """Steps at which the resolution doubles, e.g. (500, 1500): quarter, half, full."""
    stop_when_flat: bool = False
    """Stop early when the loss over the input views no longer falls."""


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
    iterations: int = 7000
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
        check.at_least("--iterations", self.iterations, 1, "Drop the flag for the default of 7000.")
        check.at_least("--threads", self.threads, 0, "0 takes one thread per core.")
        check.at_least("--seed", self.seed, 0, "Give a whole number.")

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
            document = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"Cannot read the configuration {path}: {error}. Give the folder of a gsopt run.") from error
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
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return value is None if hint is type(None) else isinstance(value, hint)
