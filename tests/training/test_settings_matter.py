"""Every setting of a run changes its splats: what is configured is also done."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from tiny_scenes import tiny_config

from gsopt.config.train import DensityConfig, OptimizerConfig, ScheduleConfig, SparseConfig, TrainConfig
from gsopt.training.loop import train

STEPS = 24
CHANGES: dict[str, dict[str, Any]] = {
    "many": {
        "seed": 1,
        "antialiased": True,
        "iterations": STEPS + 1,
        "data.background": "black",
        "init.count": 61,
        "optimizer.lr_means": 1e-3,
        "optimizer.lr_means_final": 1e-4,
        "optimizer.lr_quats": 1e-2,
        "optimizer.lr_log_scales": 0.03,
        "optimizer.lr_logit_opacities": 0.1,
        "optimizer.lr_sh0": 0.01,
        "optimizer.lr_shN": 0.01,
        "optimizer.lr_last": 0.5,
        "optimizer.beta1": 0.8,
        "optimizer.beta2": 0.9,
        "optimizer.eps": 1e-3,
        "optimizer.sh_degree": 1,
        "optimizer.sh_degree_every": 4,
        "loss.lambda_dssim": 0.5,
        "loss.lambda_alpha": 0.3,
        "loss.lambda_opacity": 0.1,
        "loss.lambda_scale": 0.1,
        "density.max_gaussians": 62,
        "density.refine_start": 12,
        "density.refine_stop": 11,
        "density.refine_every": 3,
        "density.grow_grad2d": 1.0,
        "density.absgrad": True,
        "density.prune_opacity": 0.3,
        "density.turnover": 0.5,
        "density.reset_every": 6,
        "schedule.coarse_until": (4, 9),
        "poses.refine": True,
        "exposure.learn": True,
    },
    "mcmc": {"density.noise_lr": 0.0, "density.growth": 1.5, "density.prune_opacity": 0.3, "density.max_gaussians": 62},
    "few": {
        "sparse.dropout": 0.0,
        "sparse.floater_every": 5,
        "sparse.lambda_opacity": 0.3,
        "sparse.lambda_area": 300.0,
        "sparse.lambda_alpha": 0.0,
        "sparse.sh_degree": 0,
        "sparse.below_views": 3,
        "sparse.steps_per_view": 3,
        "loss.lambda_opacity": 0.7,
        "loss.lambda_scale": 0.7,
    },
}
"""Settings in turn, in a run with many views, one of mcmc and one with few views."""


def with_setting(config: Any, name: str, value: Any) -> Any:
    """A copy with one field changed, its groups separated by dots."""
    group, _, inner = name.partition(".")
    assert group in {field.name for field in fields(config)}, name
    new = with_setting(getattr(config, group), inner, value) if inner else value
    assert is_dataclass(config)
    return replace(config, **{group: new})


def config_of(kind: str, dataset: Path) -> TrainConfig:
    density = DensityConfig(refine_start=2, refine_every=4, refine_stop=20, grow_grad2d=5e-5, max_gaussians=90)
    base = tiny_config(
        dataset,
        iterations=STEPS,
        density=density,
        optimizer=OptimizerConfig(sh_degree=2, sh_degree_every=8),
        schedule=ScheduleConfig(coarse_until=(6,)),
        sparse=SparseConfig(below_views=0),
        checkpoint_every=0,
        preview_every=0,
    )
    base = with_setting(with_setting(base, "poses.start", 4), "exposure.start", 4)
    few = SparseConfig(symmetry="off", inflate="off")
    changed = {"many": {}, "mcmc": {"density": replace(density, strategy="mcmc")}, "few": {"sparse": few}}
    return replace(base, **changed[kind])


def splats_of(config: TrainConfig, folder: Path) -> str:
    train(config, folder / "run")
    return hashlib.sha256((folder / "run" / "splat.ply").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def unchanged(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return {kind: splats_of(config_of(kind, dataset), tmp_path_factory.mktemp(kind)) for kind in CHANGES}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, changes in CHANGES.items() for name in changes])
def test_a_setting_changes_the_splats(
    kind: str, name: str, dataset: Path, unchanged: dict[str, str], tmp_path: Path
) -> None:
    config = config_of(kind, dataset)
    assert splats_of(with_setting(config, name, CHANGES[kind][name]), tmp_path) != unchanged[kind]


def test_the_same_settings_give_the_same_splats(dataset: Path, unchanged: dict[str, str], tmp_path: Path) -> None:
    assert splats_of(config_of("many", dataset), tmp_path) == unchanged["many"]
