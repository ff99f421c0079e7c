"""Laws of relocation, growth and noise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scenes import cloud

from gsopt.config.train import DensityConfig, TrainConfig
from gsopt.raster.reference import covariances
from gsopt.training.density.mcmc import Mcmc, draw, shared, spread
from gsopt.training.open_settings import MANY
from gsopt.training.optimizer import OptimizedGaussians
from gsopt.training.plan import density_plan, make_schedule

CONFIG = DensityConfig(strategy="mcmc", refine_start=0, refine_every=10, refine_stop=100, max_gaussians=60)


def controlled(config: DensityConfig = CONFIG) -> Mcmc:
    schedule = make_schedule(TrainConfig(density=config), 1000, MANY, extent=1.0, pixels=1.0)
    plan = density_plan(config, config.max_gaussians or 10**6, MANY, extent=1.0)
    return Mcmc(plan, schedule, torch.Generator().manual_seed(0))


def paper_factor(opacity: float, n: int) -> float:
    """The factor on the scales as the paper writes it (eq. 9), with its double sum."""
    new = 1 - (1 - opacity) ** (1 / n)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for i in range(1, n + 1) for k in range(i)
    )
    return opacity / total


@settings(max_examples=50, deadline=None)
@given(opacity=st.floats(0.005, 0.999), n=st.integers(1, 51))
def test_shared_is_equation_nine(opacity: float, n: int) -> None:
    new, factor = shared(torch.tensor([opacity], dtype=torch.float64), torch.tensor([n]))
    assert 1 - (1 - float(new)) ** n == pytest.approx(opacity, rel=1e-9)  # n of them are as opaque as the one
    assert float(factor) == pytest.approx(paper_factor(opacity, n), rel=1e-6)


def test_sharing_with_nobody_changes_nothing() -> None:
    o = torch.linspace(0.01, 0.99, 20, dtype=torch.float64)
    new, factor = shared(o, torch.ones(20, dtype=torch.int64))
    torch.testing.assert_close(new, o)
    torch.testing.assert_close(factor, torch.ones(20, dtype=torch.float64))


def test_the_dead_are_moved_onto_the_living_with_fresh_moments() -> None:
    gaussians = cloud(40, seed=1)
    dead = torch.arange(0, 40, 4)
    gaussians.logit_opacities[dead] = -9.0
    model = OptimizedGaussians.start(replace(gaussians, logit_opacities=gaussians.logit_opacities.clamp_min(-9.0)))
    model.exp_avg.means.fill_(1.0)
    config = replace(CONFIG, max_gaussians=40)
    refined = controlled(config).refine(10, model)

    assert len(refined) == 40
    living = torch.ones(40, dtype=torch.bool)
    living[dead] = False
    assert bool((refined.gaussians.opacities >= config.prune_opacity).all())
    assert torch.equal(refined.gaussians.means[living], gaussians.means[living])
    sources = (refined.gaussians.means[dead][:, None] == gaussians.means[living]).all(-1)
    assert bool(sources.any(dim=1).all())
    assert not refined.exp_avg.means[dead].any()
    for row in dead.tolist():  # twins: the same opacity and scale as the source now has
        twin = (refined.gaussians.means == refined.gaussians.means[row]).all(-1)
        assert len(refined.gaussians.logit_opacities[twin].unique()) == 1
        assert len(refined.gaussians.log_scales[twin].unique(dim=0)) == 1


def test_the_dead_are_never_sources_however_many_and_barely_dead() -> None:
    gaussians = cloud(400, seed=1)
    opacities = torch.full((400,), 0.99 * CONFIG.prune_opacity)
    opacities[:20] = 2 * CONFIG.prune_opacity
    model = OptimizedGaussians.start(replace(gaussians, logit_opacities=torch.logit(opacities)))
    refined = controlled(replace(CONFIG, max_gaussians=400)).refine(10, model)
    onto_living = (refined.gaussians.means[20:, None] == gaussians.means[:20]).all(-1).any(dim=1)
    assert bool(onto_living.all())


def test_sources_forget_their_moments_and_the_others_keep_them() -> None:
    gaussians = cloud(40, seed=1)
    opacities = torch.full((40,), 1e-4)
    opacities[:20] = 0.5
    model = OptimizedGaussians.start(replace(gaussians, logit_opacities=torch.logit(opacities)))
    for moments in (model.exp_avg, model.exp_avg_sq):
        moments.means.fill_(1.0)
    refined = controlled(replace(CONFIG, max_gaussians=40)).refine(10, model)
    sources = (refined.gaussians.means[20:, None] == gaussians.means[:20]).all(-1).any(dim=0)
    assert 0 < int(sources.sum()) < 20
    for moments in (refined.exp_avg, refined.exp_avg_sq):
        assert torch.equal(moments.means[:20].any(dim=1), ~sources)


@pytest.mark.parametrize(("count", "budget", "after"), [(40, 60, 42), (59, 60, 60), (60, 60, 60)])
def test_growth_is_five_per_cent_up_to_the_budget(count: int, budget: int, after: int) -> None:
    model = OptimizedGaussians.start(cloud(count, seed=2))
    refined = controlled(replace(CONFIG, max_gaussians=budget)).refine(10, model)
    assert len(refined) == after


def test_outside_its_window_the_record_is_the_very_same() -> None:
    model = OptimizedGaussians.start(cloud(5, seed=1))
    assert all(controlled().refine(step, model) is model for step in (1, 9, 110))


def test_nothing_alive_moves_nothing() -> None:
    model = OptimizedGaussians.start(replace(cloud(5, seed=1), logit_opacities=torch.full((5,), -9.0)))
    before = model.gaussians.means.clone()
    refined = controlled().refine(10, model)
    assert torch.equal(refined.gaussians.means[:5], before)


def test_spread_multiplies_by_the_covariance() -> None:
    gaussians = cloud(30, seed=6).to(torch.float64)
    vectors = torch.randn(3, 30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = (covariances(gaussians.quats, gaussians.log_scales) @ vectors.T[..., None])[..., 0]
    torch.testing.assert_close(spread(gaussians.quats, gaussians.log_scales, vectors), expected)


def test_noise_moves_the_faint_along_their_covariance_and_leaves_the_opaque() -> None:
    one = cloud(1, seed=3)
    count = 20_000
    rows = torch.zeros(count, dtype=torch.int64)
    logits = torch.full((count,), math.log(0.005 / 0.995))
    logits[: count // 2] = 2.0
    model = OptimizedGaussians.start(replace(one.select(rows), logit_opacities=logits))
    controlled().after_step(model, lr_means=1e-3)
    moves = (model.gaussians.means - one.means).double()
    assert not moves[: count // 2].any()
    faint = moves[count // 2 :] / (CONFIG.noise_lr * 1e-3 * 0.5)  # sigmoid(0) at opacity 0.005
    sigma = covariances(one.quats, one.log_scales)[0].double()
    expected = sigma @ sigma  # of Σ ξ
    measured = faint.T @ faint / len(faint)
    torch.testing.assert_close(measured, expected, rtol=0, atol=0.05 * float(expected.diagonal().max()))


def test_noise_is_the_same_for_the_same_generator() -> None:
    models = [
        OptimizedGaussians.start(replace(cloud(9, seed=1), logit_opacities=torch.full((9,), -5.0))) for _ in range(2)
    ]
    for model in models:
        controlled().after_step(model, 1e-3)
    assert torch.equal(models[0].gaussians.means, models[1].gaussians.means)


def test_rows_are_drawn_in_proportion_to_their_weights() -> None:
    weights = torch.tensor([0.0, 1.0, 3.0, 0.0, 4.0, 0.0])
    counts = torch.bincount(draw(weights, 80_000, torch.Generator().manual_seed(0)), minlength=6)
    assert counts[[0, 3, 5]].sum() == 0
    torch.testing.assert_close(counts / 10_000, weights, rtol=0, atol=0.1)


def test_one_stands_for_51_copies_at_most_and_each_for_its_own_number() -> None:
    o = torch.full((4,), 0.9, dtype=torch.float64)
    new, factor = shared(o, torch.tensor([50, 51, 52, 900]))
    assert new[0] > new[1] == new[2] == new[3]
    assert factor[0] != factor[1] == factor[2] == factor[3]
    for count in (50, 51):
        alone = shared(o[:1], torch.tensor([count]))
        assert (float(new[count - 50]), float(factor[count - 50])) == pytest.approx((float(alone[0]), float(alone[1])))
    mixed = shared(o[:3], torch.tensor([1, 2, 7]))[1]
    assert mixed.tolist() == pytest.approx([paper_factor(0.9, n) for n in (1, 2, 7)])


def test_what_is_fully_opaque_is_shared_as_if_a_ten_millionth_shone_through() -> None:
    new, factor = shared(torch.ones(1, dtype=torch.float64), torch.tensor([2]))
    assert float(new) == pytest.approx(1 - math.sqrt(1e-7))
    assert float(factor) == pytest.approx(paper_factor(1 - 1e-7, 2))


def noise_of(opacities: list[float]) -> torch.Tensor:
    """Moves of one Gaussian in copies with these opacities."""
    one = cloud(1, seed=3).select(torch.zeros(len(opacities), dtype=torch.int64))
    start = replace(one, logit_opacities=torch.logit(torch.tensor(opacities)))
    model = OptimizedGaussians.start(start)
    controlled().after_step(model, lr_means=1.0)
    return model.gaussians.means - start.means


def test_noise_fades_with_opacity_and_ends_at_a_tenth() -> None:
    """By the logistic function of -100 (o - 0.005): 1/2 at 0.005, 1/(1 + e^2) at 0.025."""
    faint, fainter = noise_of([0.025] * 3), noise_of([0.005] * 3)
    torch.testing.assert_close(faint / fainter, torch.full((3, 3), 2 / (1 + math.exp(2))), rtol=1e-3, atol=0)
    assert noise_of([0.099, 0.101]).any(dim=1).tolist() == [True, False]


def test_an_opacity_at_the_limit_is_dead() -> None:
    gaussians = cloud(40, seed=1)
    logits = torch.full((40,), -3.0)
    logits[:10] = 1.0
    limit = float(logits.sigmoid()[-1])
    model = OptimizedGaussians.start(replace(gaussians, logit_opacities=logits))
    refined = controlled(replace(CONFIG, prune_opacity=limit, max_gaussians=40)).refine(10, model)
    assert bool((refined.gaussians.means[10:, None] == gaussians.means[:10]).all(-1).any(dim=1).all())


def test_the_last_row_is_drawn_by_its_weight_too() -> None:
    rows = draw(torch.tensor([1.0, 1.0, 6.0]), 8000, torch.Generator().manual_seed(0))
    assert (torch.bincount(rows, minlength=3) / 1000).tolist() == pytest.approx([1, 1, 6], abs=0.15)


def test_no_step_is_watched() -> None:
    assert not any(controlled().watches(step, 40) for step in (1, 10, 99, 100))
