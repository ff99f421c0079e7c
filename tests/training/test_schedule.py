"""Laws of what depends on the step, and of the plan that settings and scene make together."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.config.train import DensityConfig, LossConfig, OptimizerConfig, ScheduleConfig, SparseConfig, TrainConfig
from gsopt.training import plan, schedule
from gsopt.training.open_settings import FEW_OF_A_SCENE, FEW_OF_AN_OBJECT, MANY, is_sparse, open_settings
from gsopt.training.plan import LossWeights
from gsopt.training.schedule import Flatness, Schedule

OPTIMIZER = OptimizerConfig()


def made(
    config: TrainConfig, *, views: int = 100, masked: bool = False, extent: float = 1.0, pixels: float = 1e6
) -> Schedule:
    """The schedule of a run with so many views."""
    found = open_settings(config.sparse, views, masked=masked)
    return plan.make_schedule(config, plan.shortened(config, found, views), found, extent, pixels)


def length(config: TrainConfig, views: int, *, masked: bool = False) -> int:
    """Length of a run with so many views."""
    return plan.shortened(config, open_settings(config.sparse, views, masked=masked), views)


def test_the_rate_of_the_means_ends_where_it_should_and_falls_by_the_same_factor_every_step() -> None:
    run = made(TrainConfig(iterations=500), extent=2.0)
    rates = [run.lr_means(step) for step in range(501)]
    assert rates[0] == pytest.approx(2 * MANY.lr_means)
    assert rates[-1] == pytest.approx(2 * OPTIMIZER.lr_means_final)
    factors = {round(after / before, 9) for before, after in itertools.pairwise(rates)}
    assert len(factors) == 1


def test_a_rate_of_zero_stays_zero() -> None:
    assert made(TrainConfig(iterations=10, optimizer=OptimizerConfig(lr_means=0.0))).lr_means(3) == 0.0


@settings(max_examples=50, deadline=None)
@given(step=st.integers(1, 10_000), every=st.integers(1, 3000), highest=st.integers(0, 3))
def test_bands_come_one_by_one_and_never_pass_the_highest(step: int, every: int, highest: int) -> None:
    run = made(TrainConfig(optimizer=OptimizerConfig(sh_degree=highest, sh_degree_every=every)))
    now, later = run.sh_degree(step), run.sh_degree(step + every)
    assert run.sh_degree(0) == run.sh_degree(1) == 0
    assert 0 <= now <= highest
    assert later == min(now + 1, highest)


@pytest.mark.parametrize("every", [90, 100, 300])
def test_a_run_is_complete_from_the_first_settled_step_that_draws_all_bands(every: int) -> None:
    config = TrainConfig(optimizer=OptimizerConfig(sh_degree_every=every), density=DensityConfig(refine_stop=300))
    run = made(replace(config, iterations=1000))
    steps = range(1, 1001)
    assert [run.is_complete(step) for step in steps] == [
        run.is_settled(step) and run.sh_degree(step) == run.max_sh_degree for step in steps
    ]
    assert sum(not run.is_complete(step) for step in steps) == max(run.refine_stop, *run.coarse_until, 3 * every)


def test_few_views_are_learned_more_slowly_and_what_is_given_stays() -> None:
    few, many = made(TrainConfig(), views=4), made(TrainConfig())
    assert few.lr_means(0) < many.lr_means(0)
    assert few.refine_every > many.refine_every
    assert few.learning_rates(1, 4000)["quats"] < many.learning_rates(1, 4000)["quats"]
    assert plan.density_plan(DensityConfig(), 100, FEW_OF_A_SCENE, 1.0).turnover == 0
    given = TrainConfig(optimizer=OptimizerConfig(lr_quats=0.5), density=DensityConfig(refine_every=7, turnover=0.1))
    for views in (4, 100):
        run = made(given, views=views)
        assert (run.learning_rates(1, 4000)["quats"], run.refine_every) == (0.5, 7)
    assert plan.density_plan(given.density, 100, FEW_OF_A_SCENE, 1.0).turnover == 0.1


def test_resolution_doubles_at_every_entry_and_ends_full() -> None:
    run = made(TrainConfig())
    assert [replace(run, coarse_until=(2, 4)).downscale(step) for step in range(1, 7)] == [4, 4, 2, 2, 1, 1]
    assert replace(run, coarse_until=()).downscale(1) == 1


@pytest.mark.parametrize(
    ("strategy", "iterations", "stop"),
    [("adc", 30_000, 15_000), ("adc", 7000, 4200), ("mcmc", 30_000, 24_900), ("mcmc", 40_000, 25_000)],
)
def test_refinement_ends_as_published_or_sooner_in_a_short_run(strategy: str, iterations: int, stop: int) -> None:
    config = DensityConfig(strategy=strategy)  # type: ignore[arg-type]
    run = made(TrainConfig(iterations=iterations, density=config))
    assert run.refine_stop == stop
    assert run.refines(stop - stop % 100)
    assert not run.refines(stop - stop % 100 + 100)
    assert not run.refines(run.refine_start)


def test_a_given_end_of_refinement_is_kept() -> None:
    assert plan.refine_stop(DensityConfig(refine_stop=123), 30_000) == 123


@settings(max_examples=50, deadline=None)
@given(iterations=st.integers(1, 40_000), every=st.integers(0, 5000))
def test_no_reset_is_left_unrecovered_at_the_end_of_a_run(iterations: int, every: int) -> None:
    run = made(TrainConfig(iterations=iterations, density=DensityConfig(reset_every=every)))
    resets = [step for step in range(1, iterations + 1) if run.resets(step)]
    assert all(step <= iterations - schedule.STEPS_AFTER_RESET for step in resets)
    assert all(step % every == 0 for step in resets)


def test_few_views_raise_weights_and_lower_bands_but_never_the_other_way() -> None:
    config = TrainConfig(
        loss=LossConfig(lambda_alpha=0.5), sparse=SparseConfig(below_views=4, lambda_alpha=0.1, sh_degree=1)
    )
    few, many = (plan.loss_weights(config, sparse, has_alpha=True, extent=2.0) for sparse in (True, False))
    assert many == LossWeights(
        dssim=0.2, alpha=0.5, opacity=0.0, scale=0.0, area=0.0, depth=0.1, agreed=0.0, unseen=0.0
    )
    photos = plan.loss_weights(config, sparse=True, has_alpha=False, extent=2.0)
    sparse = config.sparse
    beside = {"dssim": 0.2, "alpha": 0.5, "depth": 0.1, "agreed": 0.0, "unseen": sparse.lambda_unseen}
    assert few == LossWeights(**beside, opacity=sparse.lambda_opacity, scale=0.0, area=sparse.lambda_area / 4)
    haze = pytest.approx(sparse.lambda_opacity * plan.OPAQUE_SHARE)
    assert photos == LossWeights(**beside, opacity=haze, scale=0.0, area=0.0)
    matched = plan.loss_weights(config, sparse=True, has_alpha=False, extent=2.0, matched=True)
    assert matched == replace(photos, depth=0.0, agreed=0.1)
    assert [is_sparse(config.sparse, views) for views in (4, 5)] == [True, False]
    assert (made(config, views=4).max_sh_degree, made(config, views=5).max_sh_degree) == (1, 3)


def test_agreed_depths_are_a_target_in_the_first_third_of_a_run() -> None:
    assert [made(TrainConfig(iterations=steps)).agreed_until for steps in (900, 4000)] == [300, 1333]


def test_mcmc_regularizes_unless_its_weights_are_given() -> None:
    config = TrainConfig(density=DensityConfig(strategy="mcmc"))
    assert plan.loss_weights(config, False, True, 2.0) == LossWeights(0.2, 0.0, 0.01, 0.01, 0.0, 0.1, 0.0, 0.0)
    quiet = replace(config, loss=LossConfig(lambda_opacity=0.0, lambda_scale=0.0))
    assert plan.loss_weights(quiet, False, True, 2.0) == LossWeights(0.2, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0)


def test_dropout_of_few_views_of_an_object_falls_to_nothing_at_the_end() -> None:
    config = TrainConfig(iterations=100, sparse=SparseConfig(dropout=0.34))
    few = made(config, views=4, masked=True)
    assert [few.dropout(step) for step in (1, 50, 85, 100)] == pytest.approx([0.004, 0.2, 0.34, 0.0])
    assert made(config).dropout(85) == 0


def test_dropout_of_few_views_of_a_scene_falls_from_half_of_the_run_on() -> None:
    few = made(TrainConfig(iterations=100, sparse=SparseConfig(dropout=0.3)), views=4)
    assert [few.dropout(step) for step in (1, 50, 75, 100)] == pytest.approx([0.006, 0.3, 0.15, 0.0])


@settings(max_examples=50, deadline=None)
@given(iterations=st.integers(1, 9000), masked=st.booleans())
def test_dropout_never_passes_its_share_however_short_the_run(iterations: int, masked: bool) -> None:
    run = made(TrainConfig(iterations=iterations), views=4, masked=masked)
    shares = [run.dropout(step) for step in range(1, run.iterations + 1)]
    assert min(shares) >= 0
    assert max(shares) <= (0.6 if masked else 0.4) * (1 + 1e-12)
    assert shares[-1] == 0


def test_haze_is_removed_now_and_then_and_after_the_last_step() -> None:
    run = made(TrainConfig(iterations=12, density=DensityConfig(haze_every=5)))
    assert [step for step in range(1, 13) if run.removes_haze(step, last=12)] == [5, 10, 12]
    assert [step for step in range(1, 13) if run.removes_haze(step, last=7)] == [5, 7, 10]
    never = made(TrainConfig(iterations=12, density=DensityConfig(haze_every=0)))
    assert not any(never.removes_haze(step, last=12) for step in range(1, 13))


def test_floaters_are_never_pruned_after_the_last_step_nor_with_many_views() -> None:
    config = TrainConfig(iterations=15, sparse=SparseConfig(floater_every=5))
    assert [step for step in range(1, 16) if made(config, views=4).prunes_floaters(step)] == [5, 10]
    assert not any(made(config).prunes_floaters(step) for step in range(1, 16))


def test_a_flat_loss_ends_a_run_and_a_falling_one_never_does() -> None:
    flat, falling = Flatness.of(views=30), Flatness.of(views=30)
    assert flat.window == 120  # whole epochs, at least 100 steps
    flat_end = next(step for step in range(1, 10_000) if flat.update(1.0))
    assert flat_end == flat.window * (1 + Flatness.PATIENCE)
    assert not any(falling.update(0.99 ** (step / 10)) for step in range(5000))


def test_a_noisy_plateau_is_flat() -> None:
    flat = Flatness.of(views=100)
    losses = [1.0 + 0.05 * (window % 2) for window in range(20) for _ in range(flat.window)]
    assert next(step for step, loss in enumerate(losses, 1) if flat.update(loss)) == flat.window * (
        1 + Flatness.PATIENCE
    )


def test_rates_fall_at_the_end_but_not_with_few_views_of_a_scene() -> None:
    config = TrainConfig(iterations=1000)
    run = made(config)
    assert run.settling == 50
    shares = [run.lr_share(step, 1000) for step in range(1, 1001)]
    assert set(shares[:950]) == {1.0}
    assert all(a > b for a, b in itertools.pairwise(shares[949:]))
    assert shares[-1] == pytest.approx(config.optimizer.lr_last)
    few = config.sparse.below_views
    assert made(config, views=few, masked=True).settling == 100
    assert {made(config, views=few).lr_share(step, 1000) for step in range(1, 1001)} == {1.0}


def test_few_views_shorten_a_run_and_many_never_do() -> None:
    config = TrainConfig()
    per_view, few = FEW_OF_A_SCENE.steps_per_view, config.sparse.below_views
    assert [length(config, views) for views in (1, 4, 8)] == [per_view, 4 * per_view, 8 * per_view]
    assert length(config, few) == length(config, few + 1) == config.iterations
    assert length(config, 4, masked=True) == 4 * FEW_OF_AN_OBJECT.steps_per_view < length(config, 4)
    assert length(config.with_steps(7000), 1) == 7000
    assert length(TrainConfig(iterations=50), 4) == 50
    assert length(TrainConfig(sparse=SparseConfig(steps_per_view=7)), 4, masked=True) == 28


def test_the_budget_follows_what_the_images_show_and_the_length_of_the_run() -> None:
    assert plan.default_budget(50_000, 200, 7000, 1.44) == 72_000
    assert plan.default_budget(50_000, 200, 7000, 2.0) == 100_000
    assert plan.default_budget(50_000, 200, 28_000, 1.44) == 4 * 72_000
    assert plan.default_budget(50_000, 200, 1750, 1.44) == 36_000
    assert plan.default_budget(1, 200, 7000, 1.44) == plan.MIN_BUDGET
    assert plan.default_budget(1e9, 200, 7000, 1.44) == plan.MAX_BUDGET


def test_in_a_longer_run_every_gaussian_has_thirty_pixels_of_the_views() -> None:
    assert plan.default_budget(50_000, 60, 28_000, 1.44) == plan.default_budget(50_000, 60, 28_000, 1.6) == 100_000
    assert plan.default_budget(50_000, 1, 28_000, 1.44) == plan.default_budget(50_000, 43, 28_000, 1.44) == 72_000


def test_the_shorter_run_with_few_views_of_an_object_learns_no_fewer_gaussians() -> None:
    budgets = [
        plan.default_budget(50_000, 8, 8 * few.steps_per_view, few.gaussians_per_pixel)
        for few in (FEW_OF_A_SCENE, FEW_OF_AN_OBJECT)
    ]
    assert budgets[1] == pytest.approx(budgets[0], rel=0.01)


def test_coarse_steps_are_shares_of_the_run_unless_given() -> None:
    config = TrainConfig(iterations=1000)
    assert made(config).coarse_until == (60, 230)
    assert made(config, views=4).coarse_until == (167, 500)
    assert made(config, pixels=1).coarse_until == (60, 230)
    for coarse in ((), (5,)):
        asked = replace(config, schedule=ScheduleConfig(coarse_until=coarse))
        assert made(asked).coarse_until == made(asked, views=4, masked=True, pixels=1).coarse_until == coarse


@pytest.mark.parametrize(
    ("pixels", "coarse"), [(15_999, ()), (16_000, (230,)), (63_999, (230,)), (64_000, (60, 230)), (1e7, (60, 230))]
)
def test_an_object_in_few_views_shows_at_least_4000_pixels(pixels: float, coarse: tuple[int, ...]) -> None:
    run = made(TrainConfig(iterations=1000), views=4, masked=True, pixels=pixels)
    assert run.coarse_until == coarse
    assert pixels / run.downscale(1) ** 2 >= min(pixels, 4000)


@pytest.mark.parametrize(
    ("views", "images", "drawn"), [(4, 4, 4), (4, 24, 8), (6, 48, 5), (8, 8, 4), (8, 48, 4), (16, 16, 2), (5, 0, 0)]
)
def test_the_more_photos_the_fewer_mirror_images(views: int, images: int, drawn: int) -> None:
    scene = SimpleNamespace(train=(None,) * views, mirrored=(None,) * images, completed=False)
    assert plan.extra_per_epoch(scene) == drawn  # type: ignore[arg-type]


@pytest.mark.parametrize("iterations", [80, 1000, 4004])
def test_the_last_eighth_is_averaged_where_nothing_is_added_in_it(iterations: int) -> None:
    run = replace(
        made(TrainConfig(iterations=iterations)), refine_stop=iterations // 2, coarse_until=(iterations // 4,)
    )
    assert run.averages_after == iterations - round(iterations / 8)
    assert replace(run, refine_stop=iterations - 1).averages_after == iterations - 1
    assert replace(run, coarse_until=(5, iterations - 2)).averages_after == iterations - 2


def test_settings_that_are_left_open_are_those_of_decisions_19_and_28() -> None:
    """docs/decisions/0019-fewer-steps.md and 0028-small-objects.md; mcmc refines as with few views."""
    config, mcmc = TrainConfig(), TrainConfig(density=DensityConfig(strategy="mcmc"))
    sets = (MANY, FEW_OF_A_SCENE, FEW_OF_AN_OBJECT)
    many = {"lr_means": 3.2e-4, "lr_quats": 4e-3, "lr_shN": 5e-4, "sh_degree_every": 500}
    few = {"lr_means": 1.6e-4, "lr_quats": 1e-3, "lr_shN": 2.5e-4, "sh_degree_every": 1000}
    assert [found.of(config.optimizer) for found in sets] == [many, few, few]
    growth = {"refine_start": 200, "refine_every": 50, "grow_grad2d": 1e-4, "turnover": 0.2}
    rare = {"refine_start": 500, "refine_every": 100, "grow_grad2d": 2e-4, "turnover": 0.0}
    assert [found.growth(config.density) for found in sets] == [growth, rare, {**rare, "refine_start": 200}]
    assert [found.growth(mcmc.density) for found in sets] == [rare] * 3
    assert (made(config).refine_every, made(mcmc).refine_every) == (50, 100)


@pytest.mark.parametrize(("views", "window"), [(1, 100), (30, 120), (99, 198), (100, 100), (101, 101)])
def test_a_window_of_losses_is_of_whole_epochs_and_at_least_100_steps(views: int, window: int) -> None:
    assert Flatness.of(views).window == window


@pytest.mark.parametrize(("fall", "end"), [(0.003, None), (0.0021, None), (0.0019, 6), (0.0, 6)])
def test_five_windows_without_a_fall_of_a_500th_end_a_run(fall: float, end: int | None) -> None:
    flat = Flatness(window=1)
    ends = (window for window in range(1, 12) if flat.update((1 - fall) ** window))
    assert next(ends, None) == end


def test_a_floater_stands_out_by_four_deviations_at_first_and_by_two_at_last() -> None:
    run = made(TrainConfig(iterations=300))
    assert [run.floater_sigmas(step) for step in (0, 150, 300)] == pytest.approx([4.0, 3.0, 2.0])


def test_the_last_reset_is_in_the_last_refinement_or_2000_steps_before_the_end() -> None:
    def resets(iterations: int, every: int) -> list[int]:
        run = made(TrainConfig(iterations=iterations, density=DensityConfig(reset_every=every)))
        return [step for step in range(1, iterations + 1) if run.resets(step)]

    assert resets(4000, 1000) == [1000, 2000]
    assert resets(10_000, 2000) == [2000, 4000, 6000]  # refinement ends with step 6000
    assert resets(4000, 0) == []


def test_a_rate_that_ends_at_zero_is_zero_from_the_first_step() -> None:
    run = made(TrainConfig(iterations=10, optimizer=OptimizerConfig(lr_means_final=0.0)))
    assert [run.lr_means(step) for step in (0, 5)] == [0.0, 0.0]


def test_a_run_that_adds_nothing_is_settled_from_its_first_step() -> None:
    run = replace(made(TrainConfig()), refine_stop=0, coarse_until=())
    assert [run.is_settled(step) for step in (0, 1)] == [False, True]
    assert [replace(run, refine_stop=7).is_settled(step) for step in (7, 8)] == [False, True]
    assert [replace(run, coarse_until=(3, 9)).is_settled(step) for step in (9, 10)] == [False, True]


@given(st.integers(0, 60), st.integers(1, 25), st.integers(0, 130))
def test_the_next_refinement_is_the_first_step_that_refines(start: int, every: int, stop: int) -> None:
    config = TrainConfig(density=DensityConfig(refine_start=start, refine_every=every, refine_stop=stop))
    schedule = plan.make_schedule(config, 1000, MANY, extent=1.0, pixels=1.0)
    for step in range(1, 140):
        assert schedule.next_refinement(step) == next((s for s in range(step, 140) if schedule.refines(s)), None)
