"""Values of the settings that a config leaves open: the number of photos decides, and whether they have masks.

Few views are learned more slowly, and nothing makes room for what they show better at the cost of what other views
need (docs/decisions/0019-fewer-steps.md). Early steps only move coarse shapes, so that a run begins with small images;
few photos of a whole scene keep them longer, lest fine detail is learned as view-dependent fog. Masks keep fog away:
few views of an object need neither long coarse steps nor many, and small images lose what little they show
(docs/decisions/0028-small-objects.md). Rates fall at the end, but not where few photos show a whole scene
(docs/decisions/0032-settling.md). Dropout keeps Gaussians translucent, so that few views end without it: those of a
whole scene early (docs/decisions/0043-opaque-scenes.md), those of an object late (0044-opaque-objects.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from gsopt.config.train import DensityConfig, OptimizerConfig, SparseConfig


@dataclass(frozen=True)
class OpenSettings:
    """One set; most fields are those of OptimizerConfig, DensityConfig and SparseConfig."""

    few: bool
    """True where the regularizers for few views are on."""
    lr_means: float
    lr_quats: float
    lr_shN: float
    sh_degree_every: int
    refine_start: int
    refine_every: int
    grow_grad2d: float
    turnover: float
    steps_per_view: int
    gaussians_per_pixel: float
    """Default budget of 7000 steps, per pixel of an image that shows something."""
    coarse_shares: tuple[float, ...]
    """Shares of the run after which the resolution is half and full; before, it is a quarter."""
    settling_share: float
    """Share of the run, its last, in which all rates fall, so that it does not end in the noise of single steps."""
    dropout: float
    """Largest share of Gaussians left out of a step."""
    most_dropout_share: float
    """Share of the run after which it is largest; none are left out at the end, so that Gaussians become as opaque as
    what they show."""
    least_content: int
    """Fewest pixels that show something, mean over the photos, in an image smaller than a photo."""

    def of(self, section: OptimizerConfig | DensityConfig | SparseConfig) -> dict[str, Any]:
        """The settings of a section that may be left open, as it gives them or else as they are here."""
        given = {name: getattr(section, name) for name in vars(self) if hasattr(section, name)}
        return {name: getattr(self, name) if value is None else value for name, value in given.items()}

    def growth(self, density: DensityConfig) -> dict[str, Any]:
        """Those of density control; mcmc, which grows by a share, refines as rarely as with few views."""
        return (FEW_OF_A_SCENE if density.strategy == "mcmc" else self).of(density)


MANY = OpenSettings(
    few=False,
    lr_means=3.2e-4,
    lr_quats=4e-3,
    lr_shN=5e-4,
    sh_degree_every=500,
    refine_start=200,
    refine_every=50,
    grow_grad2d=1e-4,
    turnover=0.2,
    steps_per_view=0,
    gaussians_per_pixel=1.44,
    coarse_shares=(0.06, 0.23),
    settling_share=0.05,
    dropout=0.0,
    most_dropout_share=1.0,
    least_content=0,
)
FEW_OF_A_SCENE = OpenSettings(
    few=True,
    lr_means=1.6e-4,
    lr_quats=1e-3,
    lr_shN=2.5e-4,
    sh_degree_every=1000,
    refine_start=500,
    refine_every=100,
    grow_grad2d=2e-4,
    turnover=0.0,
    steps_per_view=500,
    gaussians_per_pixel=1.44,
    coarse_shares=(1 / 6, 1 / 2),
    settling_share=0.0,
    dropout=0.4,
    most_dropout_share=0.5,
    least_content=0,
)
FEW_OF_AN_OBJECT = replace(
    FEW_OF_A_SCENE,
    refine_start=200,
    steps_per_view=350,
    gaussians_per_pixel=1.72,
    coarse_shares=MANY.coarse_shares,
    settling_share=0.1,
    dropout=0.6,
    most_dropout_share=0.85,
    least_content=4000,
)


def open_settings(config: SparseConfig, views: int, *, masked: bool) -> OpenSettings:
    """The set for so many views, of an object with masks or of a whole scene."""
    if not is_sparse(config, views):
        return MANY
    return FEW_OF_AN_OBJECT if masked else FEW_OF_A_SCENE


def is_sparse(config: SparseConfig, views: int) -> bool:
    """True when the regularizers for few views are on."""
    return views <= config.below_views
