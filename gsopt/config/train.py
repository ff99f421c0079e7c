"""The settings of a run: frozen dataclasses, each with unit, default and bounds in its field. No torch."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from gsopt import check
from gsopt.check import Within
from gsopt.config.bounds import MAX_WEIGHT, Count, Decay, Features, PositiveCount, ShDegree, Threads, Weight
from gsopt.config.cells import CellConfig, check_cells
from gsopt.config.from_json import build
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.presets import Preset, with_preset
from gsopt.errors import InputError, SettingError

MAX_CONFIG_BYTES = 1 << 20
"""Bytes of config.json that are read."""
MAX_GAUSSIANS = 100_000_000
"""More than any machine this runs on can hold."""
MAX_COARSE_STEPS = 6
"""Halvings of the resolution at the first step."""
GONE = {"density": ("grow_scale3d",), "sparse": ("lambda_scale",)}
"""Settings per section that older versions wrote and this one has not: they are ignored."""
BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""Fixed backgrounds, RGB; `random` draws one per step."""


@dataclass(frozen=True)
class DataConfig:
    """The dataset, and the views of it that a run learns from and is evaluated on."""

    path: str = ""
    """Dataset folder: NeRF-synthetic, nerfstudio/instant-ngp, COLMAP, LLFF or IDR; or photos or a video (see gsopt
    sfm)."""
    views: PositiveCount | None = None
    """Number of input views to learn from, well spread by camera position; all by default."""
    view_ids: tuple[int, ...] | None = None
    """Exactly these input views, 0-based in name order, e.g. 2,16,26."""
    downscale: PositiveCount | None = None
    """Divisor of width and height (area filter); 1 keeps all pixels. By default the longer side of a larger photo
    becomes 1600 px."""
    eval: bool = False
    """Hold out every 8th image when the dataset has no test split of its own."""
    background: Literal["auto", "white", "black", "random"] = "auto"
    """Color behind transparent pixels and behind what no photo shows. auto: white with masks or alpha, else the mean
    color of the photos; random draws one per step and evaluates on white."""
    cache_mb: Count = 2048
    """Decoded images kept in memory, MB; the rest is read again when needed."""
    masks: str = "given"
    """Masks of the object: given (alpha or the dataset's own folder), none (no mask files), a folder with a mask named
    like each image, or auto: given ones, else made by a mask model (see gsopt masks)."""
    depth: str | None = None
    """Folder with a depth map named like each input image, .npy or 16-bit .png, of any scale and, where inverse, shift:
    from a sensor or a network. 0 is unknown."""
    depth_kind: Literal["distance", "inverse"] = "distance"
    """Content of the depth maps: distances along the viewing axis, or their inverse (disparity), as most networks give.
    """
    mask_model: str | None = None
    """ONNX file of the mask model for auto; by default $GSOPT_MASK_MODEL, else one that rembg has fetched."""
    features: Features = "auto"
    """Features that poses are found from where photos come without: sift, xfeat (learned), both, or auto (see gsopt
    sfm)."""

    def __post_init__(self) -> None:
        check.fields(self, "data")
        if self.view_ids is not None and (not self.view_ids or min(self.view_ids) < 0):
            raise SettingError(f"`data.view_ids` must be numbers from 0 up, got {list(self.view_ids)}. Try 2,16,26.")
        if self.views is not None and self.view_ids is not None:
            raise SettingError("`data.views` and `data.view_ids` were both given. Keep one of them.")


@dataclass(frozen=True)
class InitConfig:
    """The first Gaussians."""

    method: Literal["auto", "points", "hull", "stereo", "random"] = "auto"
    """Source of the first Gaussians: SfM points, the visual hull of the masks, places on which photos agree by stereo,
    or random in the frustum. auto: stereo for photos without alpha, unless as many SfM points are known or, with more
    than 16 photos, enough; else these; else the hull when there is alpha; else random."""
    count: Annotated[int, Within(1, MAX_GAUSSIANS)] = 20_000
    """Number of first Gaussians; stereo adds as many in the background."""

    def __post_init__(self) -> None:
        check.fields(self, "init")


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam's learning rates (Kerbl et al. 2023) and its constants."""

    lr_means: Weight | None = None
    """Learning rate of the means, times the scene extent; decays log-linearly to `lr_means_final` over the run. By
    default 3.2e-4, with few views 1.6e-4."""
    lr_means_final: Weight = 1.6e-5
    """Learning rate of the means at the last step, times the scene extent."""
    lr_quats: Weight | None = None
    """Learning rate of the rotations; by default 4e-3, with few views 1e-3."""
    lr_log_scales: Weight = 1.5e-2
    """Learning rate of the logarithms of the scales."""
    lr_logit_opacities: Weight = 5e-2
    """Learning rate of the opacities before the sigmoid."""
    lr_sh0: Weight = 5e-3
    """Learning rate of the base color."""
    lr_shN: Weight | None = None
    """Learning rate of the view-dependent color; by default 5e-4, with few views 2.5e-4."""
    lr_last: Annotated[float, Within(1e-6, 1)] = 0.1
    """Share of every rate at the last step: rates fall to it over the last 5 % of a run, with few views over the last
    10 % for an object with masks, never for a whole scene; 1 keeps them."""
    beta1: Decay = 0.9
    """Decay of Adam's mean gradient."""
    beta2: Decay = 0.999
    """Decay of Adam's mean squared gradient."""
    eps: Annotated[float, Within(1e-38, 1)] = 1e-15
    """Number added to the root of the mean squared gradient."""
    sh_degree: ShDegree = 3
    """Highest band of the spherical harmonics."""
    sh_degree_every: PositiveCount | None = None
    """Steps between two bands; by default 500, with few views 1000."""

    def __post_init__(self) -> None:
        check.fields(self, "optimizer")


@dataclass(frozen=True)
class LossConfig:
    """The training loss."""

    lambda_dssim: Annotated[float, Within(0, 1)] = 0.2
    """Weight of 1 - SSIM against L1."""
    lambda_alpha: Weight = 0.0
    """Weight of the L1 between rendered alpha and the image's alpha or mask."""
    lambda_depth: Weight = 0.1
    """Weight of 1 - the correlation of rendered inverse depths with those of `--depth`, where there are some. Without
    `--depth`, with few photos of a whole scene, that of their relative error where photos agree."""
    lambda_opacity: Weight | None = None
    """Weight of the mean opacity (Kheradmand et al. 2024); by default 0.01 with mcmc, 0 with adc."""
    lambda_scale: Weight | None = None
    """Weight of the mean scale, scene units (Kheradmand et al. 2024); by default 0.01 with mcmc, 0 with adc."""

    def __post_init__(self) -> None:
        check.fields(self, "loss")


@dataclass(frozen=True)
class DensityConfig:
    """Number and place of the Gaussians."""

    strategy: Literal["adc", "mcmc"] = "adc"
    """adc: split and prune by gradient (Kerbl et al. 2023); mcmc: relocate, grow to budget (Kheradmand 2024)."""
    max_gaussians: Annotated[int, Within(1, MAX_GAUSSIANS)] | None = None
    """Largest number of Gaussians; by default 1.4 per pixel that shows something, with few views of an object 1.7, for
    7000 steps: fewer in short runs, more in long runs of many views."""
    refine_start: Count | None = None
    """First step after which Gaussians are added and removed; by default 200, with few views of a whole scene and for
    mcmc 500."""
    refine_stop: Count | None = None
    """Last such step; by default min(15000, 60 % of iterations) for adc, min(25000, 83 %) for mcmc."""
    refine_every: PositiveCount | None = None
    """Steps between two refinements; by default 50, with few views and for mcmc 100."""
    grow_grad2d: Weight | None = None
    """adc: mean gradient of the projected center above which Gaussians grow (normalized device coordinates); by default
    1e-4, with few views 2e-4."""
    absgrad: bool = False
    """adc: absolute gradients (AbsGS); they need a larger grow_grad2d, about 8e-4."""
    prune_opacity: Annotated[float, Within(1e-6, 0.49)] = 0.005
    """Opacity below which adc removes Gaussians and mcmc moves them to where there is something to draw."""
    prune_scale3d: Weight = 0.1
    """adc: scale above which Gaussians are removed after the first opacity reset (fraction of the scene extent)."""
    turnover: Annotated[float, Within(0, 0.9)] | None = None
    """adc: share of the Gaussians, those that add least to the input views, that makes room for others three times in
    the second half of refinement, where the budget is full; 0 = never. By default 0.2, with few views 0."""
    reset_every: Count = 0
    """adc: steps between two opacity resets, none in the last 2000 steps; 0 = never."""
    haze_every: Count = 500
    """Steps between two removals of faint Gaussians right before a camera, in a scene without masks; 0 = never."""
    noise_lr: Weight = 5e5
    """mcmc: strength of the position noise."""
    growth: Annotated[float, Within(1, MAX_WEIGHT)] = 1.05
    """mcmc: growth per refinement, until the budget."""

    def __post_init__(self) -> None:
        check.fields(self, "density")


@dataclass(frozen=True)
class SparseConfig:
    """Regularizers for few views, switched on together at or below `below_views` input views."""

    below_views: Count = 16
    """Largest number of input views with which they are active; 0 turns them off."""
    dropout: Annotated[float, Within(0, 0.95)] | None = None
    """Largest share of Gaussians left out of a step (DropGaussian, Park et al. 2025); it rises from 0 and falls again.
    By default 0.4 at half of the run, of an object with masks 0.6 near its end."""
    floater_every: Count = 500
    """Steps between two prunings by nearest-neighbor distance (GaussianObject, Yang et al. 2024), of an object with
    masks only where no silhouette needs what goes; 0 = never."""
    lambda_opacity: Weight = 0.03
    """Weight that replaces the one of LossConfig where this is larger."""
    lambda_area: Weight = 24.0
    """Weight of the mean squared scale of an object with masks, over its squared extent: small splats cost less."""
    lambda_alpha: Weight = 0.5
    """Weight that replaces the one of LossConfig where this is larger."""
    lambda_unseen: Weight = 0.2
    """Weight of a term that keeps an object with masks free of haze as seen from other sides."""
    sh_degree: ShDegree = 2
    """Upper bound on the bands."""
    symmetry: Literal["auto", "off"] = "auto"
    """Search for the mirror planes of an object with masks, from one to three photos for its upright axis or mirrors; a
    run learns from the images that its photos have there too."""
    inflate: Literal["auto", "off"] = "auto"
    """Completion of an object that one photo with a mask shows: library shapes like its silhouette, and the inflated
    silhouette, make a body, and a run learns from views of that body from other sides too."""
    steps_per_view: Count | None = None
    """Largest number of steps per input view, since more overfit few views; 0 = no bound. By default 500, of an object
    with masks 350."""

    def __post_init__(self) -> None:
        check.fields(self, "sparse")


@dataclass(frozen=True)
class ScheduleConfig:
    """Work that a step may skip."""

    coarse_until: tuple[int, ...] | None = None
    """Steps at which the resolution doubles, e.g. 500 1500: quarter, half, full. By default shares of the run
    (training/open_settings.py); the flag without a step means full resolution throughout."""
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
        check.fields(self, "schedule")
        given = self.coarse_until or ()
        rising = all(later > earlier for earlier, later in itertools.pairwise((0, *given)))
        if not rising or len(given) > MAX_COARSE_STEPS:
            raise SettingError(
                f"`schedule.coarse_until` must be at most {MAX_COARSE_STEPS} rising steps above 0, got {list(given)}. "
                "Try 500 1500."
            )


@dataclass(frozen=True)
class PoseConfig:
    """Correction of the poses of the input views during training."""

    refine: bool = False
    """Learn a small correction of every input view's pose; held-out views stay where they are."""
    lr: Annotated[float, Within(1e-9, 0.1)] = 1e-3
    """Largest shift of a view's picture by one step, radians, at first."""
    lr_final: Annotated[float, Within(1e-9, 0.1)] = 1e-5
    """The same at the last step; log-linear in between."""
    start: Count = 500
    """Steps before the first correction: there must be something to align with."""

    def __post_init__(self) -> None:
        check.fields(self, "poses")


@dataclass(frozen=True)
class ExposureConfig:
    """Correction of the input photos' exposure and white balance during training."""

    learn: bool = False
    """Learn a factor per input photo and color channel, of mean 1 over the photos (geometric); held-out views have
    none, see cc_psnr."""
    lr: Annotated[float, Within(1e-9, 1)] = 5e-3
    """Largest change of a factor by one step, relative, at first."""
    lr_final: Annotated[float, Within(1e-9, 1)] = 5e-4
    """The same at the last step; log-linear in between."""
    start: Count = 500
    """Steps before the first change: there must be something to compare with."""

    def __post_init__(self) -> None:
        check.fields(self, "exposure")


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
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    cell: CellConfig = field(default_factory=CellConfig)
    preset: Preset = "default"
    """draft: 2000 steps with more skips; default: 4000 steps; high: 15,000 steps. Other settings win over it."""
    iterations: PositiveCount = 4000
    """Training steps; those of the preset by default, then with few views at most `sparse.steps_per_view` for each."""
    seed: Annotated[int, Within(0, 2**31 - 1)] = 0
    """Seed of every random number: same seed, same data, same bits."""
    backend: Literal["auto", "cpu", "cuda", "mps", "reference"] = "auto"
    """Rasterizer: cuda on a GPU of NVIDIA or AMD, mps on one of Apple, cpu on this processor; auto takes the GPU where
    torch finds one. reference is plain torch, a slow oracle for tiny scenes."""
    device: str = ""
    """GPU to take, as cuda:1 or mps, or cpu; left open, torch's current GPU."""
    threads: Threads = 0
    """Number of threads, 0 = one per core. The result does not depend on it."""
    max_memory: str = ""
    """Memory that a run on the CPU may need, as 8GB; one that is estimated to need more is refused before its first
    step. Left open, the memory that is free."""
    cells: str = ""
    """Learn a big scene in so many cells, one after the other or on a farm, each beside a frozen coarse model of the
    rest; auto: as few as fit into memory."""
    antialiased: bool = False
    """Mip-Splatting's 2D filter."""
    clean: bool = False
    """After the last step leave out the splats that no input view needs, as gsopt clean does; not where views that have
    no part in the decision lose more than 0.02 dB by it."""
    checkpoint_every: Count = 1000
    """Steps between two checkpoints; 0 = only at the end."""
    preview_every: Count = 500
    """Steps between two preview PLYs; 0 = none."""

    def __post_init__(self) -> None:
        check.fields(self)
        check.device(self.device)
        check_cells(self.cells)
        if self.max_memory:
            check.byte_count("--max-memory", self.max_memory)

    @staticmethod
    def of(preset: Preset = "default", iterations: int | None = None, **changes: Any) -> TrainConfig:
        """A preset with these settings changed; a section may be a mapping of its changes: `data={"views": 4}`.

        `iterations` that are given hold for few views too. Raises InputError or SettingError for a wrong setting.
        """
        start = with_preset(TrainConfig(preset=preset), preset)
        config = TrainConfig.from_dict(_merged(start.to_dict(), changes))
        return config if iterations is None else config.with_steps(iterations)

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
        return build(TrainConfig, values, "config")

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
        config = document["config"]
        for section, names in GONE.items():
            part = config.get(section)
            if isinstance(part, dict):
                config[section] = {key: value for key, value in part.items() if key not in names}
        return TrainConfig.from_dict(config)


def _merged(values: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`values` with `changes` over them, those of a section key by key."""
    new = dict(values)
    for key, value in changes.items():
        plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
        old = new.get(key)
        new[key] = _merged(old, plain) if isinstance(old, dict) and isinstance(plain, Mapping) else plain
    return new
