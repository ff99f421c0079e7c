"""What a plan and its schedule make of a run at their limits: turnovers, flat losses, budgets, and few photos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from test_skipping import cloud, ring
from tiny_scenes import tiny_config

from gsopt.config.train import DensityConfig, SparseConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.geometry import sh
from gsopt.raster.backend import Gradients
from gsopt.training import plan
from gsopt.training.open_settings import FEW_OF_AN_OBJECT, MANY
from gsopt.training.plan import RunPlan
from gsopt.training.schedule import Flatness, Schedule
from gsopt.training.skipping import Bands


@pytest.fixture(scope="module")
def scene(dataset: Path) -> Scene:
    return load_scene(str(dataset))


def schedule(scene: Scene, **changes: Any) -> Schedule:
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0))
    return replace(RunPlan.of(config, scene).schedule, **changes)


def test_room_is_made_after_a_half_two_thirds_and_five_sixths_of_the_refinements(scene: Scene) -> None:
    due = schedule(scene, iterations=3000, refine_start=0, refine_stop=1200, refine_every=100)
    assert [step for step in range(1, 3001) if due.turns_over(step)] == [600, 800, 1000]
    odd = schedule(scene, iterations=3000, refine_start=0, refine_stop=1000, refine_every=30)
    assert [step for step in range(1, 3001) if odd.turns_over(step)] == [510, 660, 840]
    late = schedule(scene, iterations=3000, refine_start=700, refine_stop=1200, refine_every=100)
    assert [step for step in range(1, 3001) if late.turns_over(step)] == [800, 1000]


@pytest.mark.parametrize(("every", "first"), [(0, None), (1, 2), (10, 11)])
def test_large_gaussians_go_once_opacities_were_reset(scene: Scene, every: int, first: int | None) -> None:
    due = schedule(scene, reset_every=every)
    assert next((step for step in range(40) if due.prunes_large(step)), None) == first


def test_the_rate_of_the_means_falls_along_the_run_and_with_all_others_at_its_end(scene: Scene) -> None:
    due = schedule(scene, iterations=100, settling=10)
    for step in (1, 50, 90, 95, 100):
        rates = due.learning_rates(step, 100)
        share = due.lr_share(step, 100)
        assert rates["means"] == pytest.approx(share * due.lr_means(step))
        assert rates["sh0"] == pytest.approx(share * due.learning_rates(1, 100)["sh0"])
    assert due.lr_share(90, 100) == 1.0
    assert due.lr_share(95, 100) == pytest.approx(due.optimizer.lr_last**0.5)
    assert due.lr_share(100, 100) == pytest.approx(due.optimizer.lr_last)


def test_a_loss_is_flat_after_five_windows_whose_mean_gains_less_than_two_thousandths() -> None:
    flat = Flatness(window=2)
    assert [flat.update(loss) for loss in (999.0, 1001.0)] == [False, False]
    assert (flat.best, flat.stale) == (1000.0, 0)
    for loss, stale, best in ((998.0, 1, 998.0), (990.0, 0, 990.0), (991.0, 1, 990.0)):
        flat.update(loss - 1)
        assert not flat.update(loss + 1)
        assert (flat.stale, flat.best) == (stale, best)
    ends = [flat.update(995.0) for _ in range(8)]
    assert ends == [False] * 7 + [True]


@pytest.mark.parametrize(
    ("pixels", "iterations", "budget"),
    [(1.0, 7000, 20_000), (1e9, 7000, 1_000_000), (1e5, 7000, 144_000), (1e5, 28_000, 576_000), (1e5, 1750, 72_000)],
)
def test_the_default_budget_grows_with_pixels_and_steps_within_its_bounds(
    pixels: float, iterations: int, budget: int
) -> None:
    """Four times the steps use four times the Gaussians, a quarter of them half as many."""
    assert plan.default_budget(pixels, 200, iterations, 1.44) == budget


@pytest.mark.parametrize(("strategy", "few", "turnover"), [("adc", False, 0.2), ("adc", True, 0.0), ("mcmc", False, 0)])
def test_only_adc_with_many_views_makes_room(strategy: Any, few: bool, turnover: float) -> None:
    config, found = DensityConfig(strategy=strategy), FEW_OF_AN_OBJECT if few else MANY
    assert plan.density_plan(config, 5, found, 2.0).turnover == turnover
    given = plan.density_plan(replace(config, turnover=0.5), 5, found, 2.0)
    assert given.turnover == (0.5 if strategy == "adc" else 0.0)


@pytest.mark.parametrize(("few", "alpha"), [(True, True), (True, False), (False, True), (False, False)])
def test_gradients_weaken_near_cameras_and_gaussians_are_averaged_with_few_photos_of_a_whole_scene(
    scene: Scene, few: bool, alpha: bool
) -> None:
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=8 if few else 0, steps_per_view=0))
    found = RunPlan.of(config, replace(scene, has_alpha=alpha))
    assert found.opaque == (few and not alpha)
    assert (found.haze_distance > 0) == (not alpha)
    assert (found.near_distance > 1) == (few and not alpha)
    assert (found.near_distance == 0) != (few and not alpha)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_whether_a_band_is_wanted_does_not_depend_on_the_unit_of_the_loss(unit: float) -> None:
    """Two views are enough to tell."""
    gaussians, cameras = cloud(50, seed=1), ring(2, 1.0).to(torch.float32)
    ratios = []
    for factor in (1.0, unit):
        bands, generator = Bands(every=2, highest=3), torch.Generator().manual_seed(0)
        nothing = torch.zeros(50, 1, 3)
        for i in range(2):
            v = factor * sh.C0 * torch.randn(50, 1, 3, generator=generator)
            bands.note(gaussians, cameras[i], Gradients(nothing, nothing, nothing, nothing, v, nothing, nothing, None))
        ratios.append(bands.ratio())
    assert ratios[0] > 0
    assert ratios[1] == pytest.approx(ratios[0], rel=1e-3)
