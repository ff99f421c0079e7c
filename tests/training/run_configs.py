"""Tiny runs with every kind of setting."""

from __future__ import annotations

import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from tiny_scenes import tiny_config

from gsopt.config.train import (
    DataConfig,
    DensityConfig,
    ExposureConfig,
    InitConfig,
    OptimizerConfig,
    PoseConfig,
    ScheduleConfig,
    SparseConfig,
    TrainConfig,
)

HANGUP = pytest.param(
    signal.SIGHUP,
    marks=pytest.mark.skipif(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN, reason="under nohup it is ignored"),
)


def opaque(dataset: Path) -> Path:
    """The same photos on gray, without alpha."""
    folder = dataset.parent / "opaque"
    if not folder.exists():
        shutil.copytree(dataset, folder)
        for path in folder.glob("*/*.png"):
            photo = Image.open(path)
            Image.alpha_composite(Image.new("RGBA", photo.size, (90, 110, 130, 255)), photo).convert("RGB").save(path)
    return folder


def configs(dataset: Path) -> dict[str, TrainConfig]:
    """Runs that between them use every random number and every statistic."""
    base = tiny_config(dataset)
    mcmc = DensityConfig(strategy="mcmc", refine_start=4, refine_every=5, refine_stop=25, max_gaussians=70)
    return {
        "adc": replace(base, sparse=SparseConfig(below_views=0)),
        "mcmc": replace(base, density=mcmc, sparse=SparseConfig(below_views=0)),
        "turnover": replace(
            base,
            density=replace(base.density, turnover=0.3, max_gaussians=61),
            sparse=SparseConfig(below_views=0),
        ),
        "few views": replace(base, sparse=SparseConfig(floater_every=7)),
        "random background": replace(base, data=DataConfig(path=str(dataset), background="random")),
        "reference backend": replace(base, backend="reference"),
        "refined poses": replace(
            base, poses=PoseConfig(refine=True, start=3, lr=3e-3), sparse=SparseConfig(below_views=0)
        ),
        "learned exposure": replace(base, exposure=ExposureConfig(learn=True, start=3)),
        "opaque photos": replace(
            base, data=DataConfig(path=str(opaque(dataset))), init=InitConfig(method="random", count=60), iterations=60
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
