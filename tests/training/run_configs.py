"""Tiny runs with every kind of setting."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tiny_scenes import tiny_config

from gsopt.config.train import (
    DataConfig,
    DensityConfig,
    OptimizerConfig,
    PoseConfig,
    ScheduleConfig,
    SparseConfig,
    TrainConfig,
)


def configs(dataset: Path) -> dict[str, TrainConfig]:
    """Runs that between them use every random number and every statistic."""
    base = tiny_config(dataset)
    mcmc = DensityConfig(strategy="mcmc", refine_start=4, refine_every=5, refine_stop=25, max_gaussians=70)
    return {
        "adc": replace(base, sparse=SparseConfig(below_views=0)),
        "mcmc": replace(base, density=mcmc, sparse=SparseConfig(below_views=0)),
        "few views": replace(base, sparse=SparseConfig(floater_every=7)),
        "random background": replace(base, data=DataConfig(path=str(dataset), background="random")),
        "reference backend": replace(base, backend="reference"),
        "refined poses": replace(
            base, poses=PoseConfig(refine=True, start=3, lr=3e-3), sparse=SparseConfig(below_views=0)
        ),
        "coarse to fine": replace(base, schedule=ScheduleConfig(coarse_until=(12,), stop_when_flat=True)),
        "skipping": replace(
            base,
            schedule=ScheduleConfig(coarse_until=(4,), crop_masked=True, rest_converged=True, bands="residual"),
            density=DensityConfig(refine_start=4, refine_every=5, refine_stop=10, max_gaussians=90),
            optimizer=OptimizerConfig(sh_degree_every=9),
            sparse=SparseConfig(below_views=0),
        ),
    }
