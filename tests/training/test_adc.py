"""Laws of split, prune and reset."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tiny_scenes import cloud
from torch import Tensor

from gsopt.config.train import DensityConfig, TrainConfig
from gsopt.gaussians import Gaussians
from gsopt.raster.backend import Gradients
from gsopt.training.density import at_least_one
from gsopt.training.density.adc import HALF_DISTANCE, HALF_LENGTH, Adc, best, split
from gsopt.training.open_settings import MANY
from gsopt.training.optimizer import OptimizedGaussians
from gsopt.training.plan import DensityPlan, density_plan, make_schedule
from gsopt.training.schedule import Schedule

EXTENT = 2.0
CONFIG = DensityConfig(refine_start=0, refine_every=10, refine_stop=100, grow_grad2d=1e-3, reset_every=50)
ITERATIONS = 10_000


def plan_of(config: DensityConfig) -> tuple[DensityPlan, Schedule]:
    schedule = make_schedule(TrainConfig(density=config), ITERATIONS, MANY, extent=EXTENT, pixels=1.0)
    return density_plan(config, config.max_gaussians or 10**6, MANY, EXTENT), schedule


def controlled(model: OptimizedGaussians, config: DensityConfig = CONFIG) -> Adc:
    return Adc(*plan_of(config), len(model))


def pulled(count: int, rows: Tensor, strength: float = 1.0, absolute: bool = False) -> Gradients:
    """Gradients of the projected centers that lie on `rows` only."""
    v = torch.zeros(count, 2)
    v[rows, 0] = strength
    nothing = dict.fromkeys(("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"), torch.empty(0))
    return Gradients(**nothing, means2d=torch.zeros(count, 2) if absolute else v, means2d_abs=v if absolute else None)


def scene(scales: list[float], opacities: list[float]) -> Gaussians:
    """Gaussians of these scales and opacities."""
    base = cloud(len(scales), seed=2)
    return Gaussians(
        base.means,
        base.quats,
        torch.tensor(scales).log()[:, None].repeat(1, 3),
        torch.logit(torch.tensor(opacities)),
        base.sh0,
        base.shN,
    )


def seen(count: int) -> Tensor:
    return torch.ones(count, 2, dtype=torch.int32)


SMALL, LARGE = 0.01, 0.04


def test_statistics_are_the_mean_norm_in_normalized_device_coordinates() -> None:
    model = OptimizedGaussians.start(cloud(3, seed=1))
    density = controlled(model)
    radii = torch.tensor([[1, 1], [3, 3], [0, 0]], dtype=torch.int32)
    v = torch.tensor([[3.0, 0.0], [0.5, 1.0], [0.0, 0.0]])
    gradients = pulled(3, torch.tensor([0]))
    gradients.means2d.copy_(v)
    density.after_backward(gradients, radii, width=20, height=10)
    density.after_backward(gradients, radii * torch.tensor([[1], [0], [0]], dtype=torch.int32), width=20, height=10)
    torch.testing.assert_close(density.grad_sum, torch.tensor([60.0, 2 * math.hypot(5, 5), 0.0]))
    assert density.seen.tolist() == [2, 1, 0]


def test_the_absolute_gradient_is_used_when_there_is_one() -> None:
    model = OptimizedGaussians.start(cloud(4, seed=1))
    density = controlled(model)
    density.after_backward(pulled(4, torch.tensor([2]), absolute=True), seen(4), 10, 10)
    assert density.grad_sum.nonzero().flatten().tolist() == [2]


def test_what_is_pulled_becomes_two_halves_and_the_rest_stays() -> None:
    gaussians = scene([SMALL, LARGE, SMALL, LARGE], [0.5] * 4)
    model = OptimizedGaussians.start(gaussians)
    model.exp_avg.means.fill_(7.0)
    density = controlled(model)
    density.after_backward(pulled(4, torch.tensor([0, 1])), seen(4), 10, 10)
    grown = density.refine(10, model)

    assert len(grown) == 6  # 2, 3, the first halves of 0 and 1, the second ones
    for name, tensor in grown.gaussians.items():
        assert torch.equal(tensor[:2], getattr(gaussians, name)[2:])
        if name not in ("means", "log_scales"):
            assert torch.equal(tensor[2:], getattr(gaussians, name)[[0, 1, 0, 1]])
    assert grown.exp_avg.means.tolist() == [[7.0] * 3] * 2 + [[0.0] * 3] * 4
    assert not density.grad_sum.any()
    assert len(density.grad_sum) == 6


def test_below_the_threshold_nothing_grows() -> None:
    model = OptimizedGaussians.start(scene([SMALL, LARGE], [0.5, 0.5]))
    density = controlled(model)
    density.after_backward(pulled(2, torch.tensor([0, 1]), strength=0.9e-3 / 5), seen(2), 10, 10)
    assert len(density.refine(10, model)) == 2


@pytest.mark.parametrize(
    ("step", "count", "turnover", "watched"),
    [(1, 98, 0.0, True), (1, 99, 0.0, False), (100, 98, 0.0, True), (101, 98, 0.2, False)]
    + [(step, 99, 0.2, watched) for step, watched in ((40, False), (41, True), (50, True), (51, False))]
    + [(50, 99, 0.0, False), (62, 99, 0.2, True), (82, 100, 0.2, False)],
)
def test_a_step_is_watched_where_the_next_refinement_has_room_or_makes_some(
    step: int, count: int, turnover: float, watched: bool
) -> None:
    """Refinements every 10 steps until 100; those at 50, 70 and 80 make room."""
    config = replace(CONFIG, max_gaussians=100, turnover=turnover)
    assert controlled(OptimizedGaussians.start(cloud(3, seed=1)), config).watches(step, count) == watched


@pytest.mark.parametrize(("transparent", "left"), [(0, 100), (1, 100), (2, 98)])
def test_a_set_that_stays_full_is_left_alone(transparent: int, left: int) -> None:
    """99 of 100 are full; what was summed is forgotten all the same."""
    opacities = [0.5 * CONFIG.prune_opacity] * transparent + [0.5] * (100 - transparent)
    model = OptimizedGaussians.start(scene([SMALL] * 100, opacities))
    density = controlled(model, replace(CONFIG, max_gaussians=100))
    density.after_backward(pulled(100, torch.arange(100)), seen(100), 10, 10)
    refined = density.refine(10, model)
    assert len(refined) == left
    assert (refined is model) == (left == 100)
    assert len(density.grad_sum) == left
    assert not density.grad_sum.any()


@pytest.mark.parametrize("budget", [10, 13, 17, 20, 25])
def test_the_budget_is_exact_and_goes_to_the_highest_scores(budget: int) -> None:
    config = DensityConfig(**{**CONFIG.__dict__, "max_gaussians": budget})
    model = OptimizedGaussians.start(scene([SMALL] * 10, [0.5] * 10))
    density = controlled(model, config)
    gradients = pulled(10, torch.arange(10))
    gradients.means2d[:, 0] = torch.arange(1.0, 11.0).flip(0)
    density.after_backward(gradients, seen(10), 10, 10)
    grown = density.refine(10, model)
    assert len(grown) == min(budget, 20)
    halved = min(budget, 20) - 10
    torch.testing.assert_close(grown.gaussians.means[: 10 - halved], model.gaussians.means[halved:], rtol=0, atol=0)


def test_equal_scores_are_taken_in_row_order() -> None:
    chosen = best(torch.tensor([True, False, True, True]), torch.ones(4), room=2)
    assert chosen.tolist() == [True, False, True, False]


def test_halves_lie_side_by_side_along_the_longest_axis() -> None:
    """A quarter turn about z: the longest axis, y of the Gaussian, points along -x of the world."""
    half_turn = math.sqrt(0.5)
    whole = replace(
        cloud(1, seed=4),
        quats=torch.tensor([[half_turn, 0.0, 0.0, half_turn]]),
        log_scales=torch.tensor([[0.1, 0.3, 0.2]]).log(),
    )
    halves = split(whole)
    along = HALF_DISTANCE * 0.3
    torch.testing.assert_close(halves.means - whole.means, torch.tensor([[-along, 0.0, 0.0], [along, 0.0, 0.0]]))
    torch.testing.assert_close(halves.scales, torch.tensor([[0.1, 0.3 * HALF_LENGTH, 0.2]]).repeat(2, 1))


def test_halves_together_are_as_wide_as_the_whole() -> None:
    """The variance of two equal Gaussians about their common center is within a twentieth of the whole's."""
    assert pytest.approx(1, abs=0.05) == HALF_LENGTH**2 + HALF_DISTANCE**2


def test_the_transparent_go_and_the_huge_go_once_opacities_were_reset() -> None:
    huge = 2 * CONFIG.prune_scale3d * EXTENT
    gaussians = scene([SMALL, SMALL, huge], [0.5, 0.5 * CONFIG.prune_opacity, 0.5])
    early, late = OptimizedGaussians.start(gaussians), OptimizedGaussians.start(gaussians)
    assert torch.equal(controlled(early).refine(10, early).gaussians.means, gaussians.means[[0, 2]])
    assert torch.equal(controlled(late).refine(60, late).gaussians.means, gaussians.means[[0]])


def test_neither_the_huge_nor_the_transparent_are_split() -> None:
    huge = 2 * CONFIG.prune_scale3d * EXTENT
    gaussians = scene([LARGE, huge, LARGE], [0.5, 0.5, 0.5 * CONFIG.prune_opacity])
    for step, rows in ((10, 4), (60, 2)):  # the huge stay until opacities were reset
        model = OptimizedGaussians.start(gaussians)
        density = controlled(model)
        density.after_backward(pulled(3, torch.arange(3)), seen(3), 10, 10)
        assert len(density.refine(step, model)) == rows


def test_a_reset_caps_opacities_and_forgets_their_moments() -> None:
    model = OptimizedGaussians.start(scene([SMALL] * 3, [0.9, 0.5, 0.008]))
    for moments in (model.exp_avg, model.exp_avg_sq):
        moments.logit_opacities.fill_(1.0)
        moments.means.fill_(1.0)
    refined = controlled(model).refine(50, model)
    torch.testing.assert_close(refined.gaussians.opacities, torch.tensor([0.01, 0.01, 0.008]))
    assert not refined.exp_avg.logit_opacities.any()
    assert not refined.exp_avg_sq.logit_opacities.any()
    assert refined.exp_avg.means.all()


def test_between_refinements_the_record_is_the_very_same() -> None:
    model = OptimizedGaussians.start(cloud(5, seed=1))
    density = controlled(model)
    assert all(density.refine(step, model) is model for step in (1, 9, 11, 101, 110))


def test_something_is_always_left() -> None:
    model = OptimizedGaussians.start(scene([SMALL] * 3, [1e-4, 3e-4, 2e-4]))
    refined = controlled(model).refine(10, model)
    assert torch.equal(refined.gaussians.means, model.gaussians.means[[1]])
    assert len(at_least_one(torch.zeros(0, dtype=torch.bool), torch.zeros(0))) == 0


def test_statistics_follow_rows_and_return_from_a_checkpoint() -> None:
    model = OptimizedGaussians.start(cloud(6, seed=1))
    density = controlled(model)
    density.after_backward(pulled(6, torch.tensor([1, 4]), 2.0), seen(6), 10, 10)
    rows = torch.tensor([4, 0, 5])
    before = density.grad_sum[rows]
    density.select(rows)
    assert torch.equal(density.grad_sum, before)
    other = controlled(model)
    other.restore(density.tensors())
    assert torch.equal(other.grad_sum, density.grad_sum)
    assert torch.equal(other.seen, density.seen)


@pytest.mark.parametrize(("strength", "count"), [(0.9, 3), (1.1, 4)])
def test_the_mean_over_the_views_decides_and_not_the_sum(strength: float, count: int) -> None:
    """Three views of 10 px pull one Gaussian by that share of the threshold each."""
    model = OptimizedGaussians.start(scene([LARGE] * 3, [0.5] * 3))
    density = controlled(model)
    for _ in range(3):
        density.after_backward(pulled(3, torch.tensor([1]), strength * 1e-3 / 5), seen(3), 10, 10)
    assert len(density.refine(10, model)) == count
