"""Rows and their moments stay together; the steps are Adam's."""

from __future__ import annotations

import pytest
import torch
from tiny_scenes import cloud, ring

from gsopt.config.train import OptimizerConfig
from gsopt.gaussians import PARAMETERS
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.training.optimizer import OptimizedGaussians, adam_step, learning_rates

CONFIG = OptimizerConfig(lr_means=1e-3, lr_quats=4e-3, lr_shN=5e-4)
RATES = learning_rates(CONFIG, 1e-3)


def random_gradients(model: OptimizedGaussians, seed: int) -> Gradients:
    generator = torch.Generator().manual_seed(seed)
    grads = {name: torch.randn(tensor.shape, generator=generator) for name, tensor in model.gaussians.items()}
    return Gradients(**grads, means2d=torch.zeros(len(model), 2), means2d_abs=None)


def step(model: OptimizedGaussians, seed: int, sh_degree: int) -> None:
    camera, settings = ring(1, 0.0), RasterSettings(sh_degree=sh_degree)
    adam_step(model, random_gradients(model, seed), RATES, CONFIG, make_backend("reference"), camera, settings)


def stepped(steps: int, sh_degree: int = 1) -> OptimizedGaussians:
    model = OptimizedGaussians.start(cloud(12, seed=1))
    for seed in range(steps):
        step(model, seed, sh_degree)
    return model


def test_the_steps_are_those_of_torch() -> None:
    model, start = stepped(5), cloud(12, seed=1)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in start.items()}
    optimizer = torch.optim.Adam(
        [{"params": [leaf], "lr": RATES[name]} for name, leaf in leaves.items()],
        betas=(CONFIG.beta1, CONFIG.beta2),
        eps=CONFIG.eps,
    )
    for seed in range(5):
        gradients = random_gradients(OptimizedGaussians.start(start), seed)
        for name, leaf in leaves.items():
            leaf.grad = getattr(gradients, name)
        optimizer.step()
    for name, tensor in model.gaussians.items():
        torch.testing.assert_close(tensor, leaves[name].detach(), rtol=1e-5, atol=1e-7)


def test_the_callers_gaussians_are_left_alone() -> None:
    start = cloud(12, seed=1)
    model = OptimizedGaussians.start(start)
    step(model, 0, 1)
    assert not torch.equal(model.gaussians.means, start.means)
    torch.testing.assert_close(start.means, cloud(12, seed=1).means, rtol=0, atol=0)


def test_bands_that_are_not_drawn_take_no_step() -> None:
    model = stepped(3, sh_degree=0)
    assert torch.equal(model.gaussians.shN, cloud(12, seed=1).shN)
    assert model.steps == {**dict.fromkeys(PARAMETERS, 3), "shN": 0}


@pytest.mark.parametrize("record", ["gaussians", "exp_avg", "exp_avg_sq"])
def test_moments_follow_their_rows_and_new_rows_have_none(record: str) -> None:
    model = stepped(3)
    rows = torch.tensor([7, 2, 2, 0])
    chosen = model.select(rows)
    grown = chosen.append(cloud(3, seed=8))
    for name, tensor in getattr(grown, record).items():
        assert torch.equal(tensor[:4], getattr(getattr(model, record), name)[rows])
        expected = getattr(cloud(3, seed=8), name) if record == "gaussians" else torch.zeros_like(tensor[4:])
        assert torch.equal(tensor[4:], expected)
    assert grown.steps == model.steps


def test_forgetting_zeroes_the_moments_of_these_rows_only() -> None:
    model, untouched = stepped(3), stepped(3)
    model.forget(torch.tensor([1, 4]))
    for record in ("exp_avg", "exp_avg_sq"):
        for name, tensor in getattr(model, record).items():
            expected = getattr(getattr(untouched, record), name).clone()
            assert expected[[1, 4]].any()
            expected[[1, 4]] = 0
            assert torch.equal(tensor, expected)
    assert torch.equal(model.gaussians.means, untouched.gaussians.means)


def test_a_share_of_the_rates_leaves_that_of_the_means_as_it_is() -> None:
    config = OptimizerConfig(lr_means=1.0, lr_quats=0.5, lr_shN=0.25)
    whole, half = learning_rates(config, 0.125), learning_rates(config, 0.125, 0.5)
    assert whole.keys() == half.keys() == set(PARAMETERS)
    assert (whole["quats"], half["quats"], half["shN"]) == (0.5, 0.25, 0.125)
    assert half["sh0"] == pytest.approx(config.lr_sh0 / 2)
    assert whole["means"] == half["means"] == 0.125
