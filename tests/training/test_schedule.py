"""Laws of what depends on the step."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.config.train import DensityConfig, LossConfig, OptimizerConfig, ScheduleConfig, SparseConfig, TrainConfig
from gsopt.training import schedule
from gsopt.training.schedule import Flatness

OPTIMIZER = OptimizerConfig()


def test_the_rate_of_the_means_ends_where_it_should_and_falls_by_the_same_factor_every_step() -> None:
    rates = [schedule.lr_means(step, 500, OPTIMIZER, extent=2.0) for step in range(501)]
    assert rates[0] == pytest.approx(2 * OPTIMIZER.lr_means)
    assert rates[-1] == pytest.approx(2 * OPTIMIZER.lr_means_final)
    factors = {round(after / before, 9) for before, after in itertools.pairwise(rates)}
    assert len(factors) == 1


def test_a_rate_of_zero_stays_zero() -> None:
    assert schedule.lr_means(3, 10, OptimizerConfig(lr_means=0.0), 1.0) == 0.0


@settings(max_examples=50, deadline=None)
@given(step=st.integers(1, 10_000), every=st.integers(1, 3000), highest=st.integers(0, 3))
def test_bands_come_one_by_one_and_never_pass_the_highest(step: int, every: int, highest: int) -> None:
    config = OptimizerConfig(sh_degree_every=every)
    now, later = (schedule.sh_degree(s, config, highest) for s in (step, step + every))
    assert schedule.sh_degree(1, config, highest) == 0
    assert 0 <= now <= highest
    assert later == min(now + 1, highest)


def test_resolution_doubles_at_every_entry_and_ends_full() -> None:
    assert [schedule.downscale(step, (2, 4)) for step in range(1, 7)] == [4, 4, 2, 2, 1, 1]
    assert schedule.downscale(1, ()) == 1


@pytest.mark.parametrize(
    ("strategy", "iterations", "stop"),
    [("adc", 30_000, 15_000), ("adc", 7000, 4200), ("mcmc", 30_000, 24_900), ("mcmc", 40_000, 25_000)],
)
def test_refinement_ends_as_published_or_sooner_in_a_short_run(strategy: str, iterations: int, stop: int) -> None:
    config = DensityConfig(strategy=strategy)  # type: ignore[arg-type]
    assert schedule.refine_stop(config, iterations) == stop
    assert schedule.refines(stop - stop % 100, config, iterations)
    assert not schedule.refines(stop - stop % 100 + 100, config, iterations)
    assert not schedule.refines(config.refine_start, config, iterations)


def test_a_given_end_of_refinement_is_kept() -> None:
    assert schedule.refine_stop(DensityConfig(refine_stop=123), 30_000) == 123


@settings(max_examples=50, deadline=None)
@given(iterations=st.integers(1, 40_000), every=st.integers(0, 5000))
def test_no_reset_scars_the_end_of_a_run(iterations: int, every: int) -> None:
    config = DensityConfig(reset_every=every)
    resets = [step for step in range(1, iterations + 1) if schedule.resets(step, config, iterations)]
    assert all(step <= iterations - schedule.STEPS_AFTER_RESET for step in resets)
    assert all(step % every == 0 for step in resets)


def test_few_views_raise_weights_and_lower_bands_but_never_the_other_way() -> None:
    config = TrainConfig(
        loss=LossConfig(lambda_alpha=0.5), sparse=SparseConfig(below_views=4, lambda_alpha=0.1, sh_degree=1)
    )
    few, many = schedule.weights(config, 4), schedule.weights(config, 5)
    assert many == schedule.Weights(alpha=0.5, opacity=0.0, scale=0.0)
    assert few == schedule.Weights(alpha=0.5, opacity=config.sparse.lambda_opacity, scale=config.sparse.lambda_scale)
    assert (schedule.max_sh_degree(config, 4), schedule.max_sh_degree(config, 5)) == (1, 3)


def test_mcmc_regularises_unless_told_otherwise() -> None:
    config = TrainConfig(density=DensityConfig(strategy="mcmc"))
    assert schedule.weights(config, 100) == schedule.Weights(0.0, 0.01, 0.01)
    quiet = replace(config, loss=LossConfig(lambda_opacity=0.0, lambda_scale=0.0))
    assert schedule.weights(quiet, 100) == schedule.Weights(0.0, 0.0, 0.0)


def test_dropout_rises_from_nothing_to_its_share() -> None:
    config = TrainConfig(sparse=SparseConfig(dropout=0.3))
    assert schedule.dropout(100, 100, config) == pytest.approx(0.3)
    assert schedule.dropout(1, 100, config) == pytest.approx(0.003)


def test_floaters_are_never_pruned_after_the_last_step() -> None:
    config = TrainConfig(sparse=SparseConfig(floater_every=5))
    assert [step for step in range(1, 16) if schedule.prunes_floaters(step, 15, config)] == [5, 10]


def test_a_flat_loss_ends_a_run_and_a_falling_one_never_does() -> None:
    flat, falling = Flatness.of(views=30), Flatness.of(views=30)
    assert flat.window == 120  # whole epochs, at least 100 steps
    flat_end = next(step for step in range(1, 10_000) if flat.update(1.0))
    assert flat_end == flat.window * (1 + Flatness.PATIENCE)
    assert not any(falling.update(0.99 ** (step / 10)) for step in range(5000))


def test_rates_fall_at_the_end_but_not_with_few_views() -> None:
    config = TrainConfig(iterations=1000)
    settling = schedule.settling_steps(config, views=100)
    assert settling == 50
    shares = [schedule.lr_share(step, 1000, settling, config.optimizer) for step in range(1, 1001)]
    assert set(shares[:950]) == {1.0}
    assert all(a > b for a, b in itertools.pairwise(shares[949:]))
    assert shares[-1] == pytest.approx(config.optimizer.lr_last)
    few = schedule.settling_steps(config, views=config.sparse.below_views)
    assert schedule.lr_share(1000, 1000, few, config.optimizer) == 1.0


def test_few_views_shorten_a_run_and_many_never_do() -> None:
    config = TrainConfig()
    per_view, few = config.sparse.steps_per_view, config.sparse.below_views
    assert [schedule.shortened(config, views).iterations for views in (1, 4, 8)] == [
        per_view,
        4 * per_view,
        8 * per_view,
    ]
    assert schedule.shortened(config, few) == schedule.shortened(config, few + 1) == config
    meant = config.with_steps(7000)
    assert schedule.shortened(meant, 1) == meant
    assert meant.iterations == 7000
    short = TrainConfig(iterations=50)
    assert schedule.shortened(short, 4) == short


def test_the_budget_follows_what_the_images_show_and_the_length_of_the_run() -> None:
    short, long = TrainConfig(iterations=7000), TrainConfig(iterations=28_000)
    assert schedule.max_gaussians(short, 50_000) == 72_000
    assert schedule.max_gaussians(long, 50_000) == 4 * schedule.max_gaussians(short, 50_000)
    assert schedule.max_gaussians(TrainConfig(iterations=1750), 50_000) == 36_000
    assert schedule.max_gaussians(short, 1) == schedule.SMALLEST_BUDGET
    assert schedule.max_gaussians(short, 1e9) == schedule.LARGEST_BUDGET
    given = TrainConfig(density=DensityConfig(max_gaussians=17))
    assert schedule.max_gaussians(given, 50_000) == 17


def test_coarse_steps_are_shares_of_the_run_unless_given() -> None:
    config = TrainConfig(iterations=1000)
    assert schedule.coarse_until(config, 100) == (60, 230)
    assert schedule.coarse_until(config, 8) == (167, 500)
    full = replace(config, schedule=ScheduleConfig(coarse_until=()))
    assert schedule.coarse_until(full, 100) == ()


@pytest.mark.parametrize(
    ("views", "images", "drawn"), [(4, 4, 4), (4, 24, 8), (8, 8, 4), (8, 48, 4), (16, 16, 2), (5, 0, 0)]
)
def test_the_more_photos_the_fewer_mirror_images(views: int, images: int, drawn: int) -> None:
    assert schedule.mirrored_per_epoch(views, images) == drawn
