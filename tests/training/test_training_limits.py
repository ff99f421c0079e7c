"""Limits of a run's parts, met exactly and passed by one, and what a plan makes of few photos."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import ring, tiny_config

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DensityConfig, LossConfig, PoseConfig, SparseConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import GsoptError, InputError, NumericalError
from gsopt.raster.device.memory import PRIOR_BYTES, Memory
from gsopt.sds.select_prior import LIBRARY, NOT_ASKED
from gsopt.training import floaters, loop, plan, run_directory, trainer
from gsopt.training.cells import plan as cell_plan
from gsopt.training.cells import stages
from gsopt.training.cells.plan import Cell
from gsopt.training.checkpoint import Checkpoint
from gsopt.training.frame_loss import depth_gradients
from gsopt.training.open_settings import MANY
from gsopt.training.plan import RunPlan
from gsopt.training.skipping import Bands, Resting
from gsopt.training.targets import Target, content_pixels


def scene(views: int, **fields: Any) -> Any:
    cameras = ring(views, 1.0)
    train = [SimpleNamespace(name=f"{i}", camera=cameras[i]) for i in range(views)]
    return SimpleNamespace(**{"train": train, "extent": 3.0, "has_alpha": False, "completed": False, **fields})


def test_haze_of_a_whole_scene_costs_a_third_of_what_it_costs_an_object() -> None:
    config = TrainConfig()
    masked, whole = (plan.loss_weights(config, sparse=True, has_alpha=alpha, extent=1.0) for alpha in (True, False))
    assert masked.opacity == pytest.approx(3 * whole.opacity)
    assert masked.opacity > 0


def test_what_cameras_look_at_has_a_distance_where_no_mask_keeps_haze_away() -> None:
    assert plan.focus_distance(scene(6)) == pytest.approx(math.hypot(3, 1), rel=0.05)
    assert plan.focus_distance(scene(6, has_alpha=True)) == 0.0
    apart = scene(6)
    for view in apart.train:
        back = view.camera.viewmats.clone()
        back[:, 1:3] *= -1  # turned about its own x axis: it looks away
        view.camera = replace(view.camera, viewmats=back)
    assert plan.focus_distance(apart) == 0.0


@pytest.mark.parametrize(
    ("inflate", "below", "refine", "views", "guessed"),
    [
        ("auto", 8, False, 1, True),
        ("off", 8, False, 1, False),
        ("auto", 0, False, 1, False),
        ("auto", 8, True, 1, False),
    ],
)
def test_a_body_is_guessed_unless_something_speaks_against_it(
    inflate: Any, below: int, refine: bool, views: int, guessed: bool
) -> None:
    config = TrainConfig(sparse=SparseConfig(inflate=inflate, below_views=below), poses=PoseConfig(refine=refine))
    assert plan.guesses(config, views) == guessed


def test_photos_are_matched_where_there_are_two_or_more_of_a_whole_scene() -> None:
    config = TrainConfig()
    most = min(plan.MAX_MATCHED, config.sparse.below_views)
    found = {views: plan.matches_photos(config, scene(views)) for views in (1, 2, most, most + 1)}
    assert found == {1: False, 2: True, most: True, most + 1: False}
    assert not plan.matches_photos(config, scene(2, has_alpha=True))
    assert not plan.matches_photos(replace(config, loss=LossConfig(lambda_depth=0.0)), scene(2))
    assert not plan.matches_photos(replace(config, data=replace(config.data, depth="maps")), scene(2))


def test_guessed_views_are_one_beside_every_photo() -> None:
    assert plan.extra_per_epoch(scene(1, completed=True, mirrored=())) == 1
    assert plan.extra_per_epoch(scene(3, completed=True, mirrored=())) == 3


def test_a_short_run_has_no_coarse_step_of_none() -> None:
    assert plan.coarse_until(None, MANY, 8, 1e6) == (2,)
    assert plan.coarse_until(None, MANY, 2, 1e6) == ()


def test_targets_take_half_as_much_memory_as_images(dataset: Path) -> None:
    config = tiny_config(dataset)
    found = RunPlan.of(config, load_scene(config.data))
    assert found.target_cache_mb == config.data.cache_mb / 2
    assert found.density.prune_scale == pytest.approx(config.density.prune_scale3d * load_scene(config.data).extent)


@pytest.mark.parametrize(("before", "after", "rests"), [(1.0, 0.99, False), (1.0, 0.9901, True), (2.0, 1.979, False)])
def test_a_view_rests_when_its_loss_fell_by_less_than_a_hundredth(before: float, after: float, rests: bool) -> None:
    resting = Resting(1)
    resting.note(0, before)
    resting.note(0, after)
    assert resting.skips(0) == rests


@pytest.mark.parametrize(("ratio", "degree"), [(2.0, 0), (2.001, 1)])
def test_a_band_is_raised_by_more_than_twice_what_chance_gives(
    monkeypatch: pytest.MonkeyPatch, ratio: float, degree: int
) -> None:
    monkeypatch.setattr(Bands, "ratio", lambda self: ratio)
    bands = Bands(every=10, highest=1)
    bands.decide(9)
    assert bands.degree == 0
    for step in (10, 20):
        bands.decide(step)
        assert bands.degree == degree


def test_the_sums_of_bands_fit_their_degree_and_gaussians() -> None:
    def sums(count: int, band: int) -> dict[str, torch.Tensor]:
        shapes = {"n": (count,), "g": (count, 3), "gg": (count, 3), "Y": (count, band), "YY": (count, band)}
        return {name: torch.ones(shape) for name, shape in {**shapes, "Yg": (count, band, 3)}.items()}

    cpu = torch.device("cpu")
    for degree, band in ((0, 3), (1, 5), (2, 7)):
        Bands(10, 3).restore({"degree": torch.tensor(degree), **sums(4, band)}, 4, cpu)
        with pytest.raises(ValueError, match="sums of the bands"):
            Bands(10, 3).restore({"degree": torch.tensor(degree), **sums(4, band + 1)}, 4, cpu)
        with pytest.raises(ValueError, match="sums of the bands"):
            Bands(10, 3).restore({"degree": torch.tensor(degree), **sums(3, band)}, 4, cpu)
    Bands(10, 3).restore({"degree": torch.tensor(3)}, 4, cpu)
    for wrong in (-1, 4):
        with pytest.raises(ValueError, match="sums of the bands"):
            Bands(10, 3).restore({"degree": torch.tensor(wrong)}, 4, cpu)


@pytest.mark.parametrize(("known", "told"), [(15, False), (16, True)])
def test_a_correlation_of_depths_needs_16_pixels_that_show_something(known: int, told: bool) -> None:
    depths = torch.linspace(1, 2, 25).view(5, 5)
    alphas = torch.full((5, 5), 0.5)  # no more than half opaque: no surface
    alphas.view(-1)[:known] = 0.51
    target: Any = SimpleNamespace(
        inverse_depths=torch.rand(5, 5, generator=torch.Generator().manual_seed(0)), alphas=None
    )
    v_depths, v_alphas = depth_gradients(depths, alphas, target, 1.0)
    assert bool(v_depths.any()) == bool(v_alphas.any()) == told
    covered: Any = SimpleNamespace(inverse_depths=target.inverse_depths, alphas=torch.full((5, 5), 0.5))
    assert not depth_gradients(depths, torch.ones(5, 5), covered, 1.0)[0].any()


def test_what_a_photo_shows_is_the_mean_of_16_spread_views() -> None:
    def view(pixels: int) -> Any:
        rgba = torch.zeros(1, 100, 4, dtype=torch.uint8)
        rgba[0, :pixels, 3] = 255
        return SimpleNamespace(pixels=lambda: rgba)

    sizes = list(range(40))
    chosen = [sizes[i * 40 // 16] for i in range(16)]
    assert content_pixels([view(size) for size in sizes]) == pytest.approx(sum(chosen) / 16)
    half = torch.full((2, 5, 4), 51, dtype=torch.uint8)
    assert content_pixels([SimpleNamespace(pixels=lambda: half)]) == pytest.approx(2.0)  # type: ignore[list-item]
    assert content_pixels([SimpleNamespace(pixels=lambda: half[..., :3])]) == 10.0  # type: ignore[list-item]


@pytest.mark.parametrize(("count", "found"), [(63, False), (64, True)])
def test_of_64_gaussians_one_far_out_is_a_floater_and_of_63_none_is(count: int, found: bool) -> None:
    means = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    means[7] = 50.0
    assert bool(floaters.solitary(means, 4.0)[7]) == found
    assert int(floaters.solitary(means, 4.0).sum()) == int(found)


def test_neighbors_are_the_root_of_all_and_never_the_gaussian_itself() -> None:
    means = torch.rand(100, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    apart = torch.cdist(means, means).fill_diagonal_(math.inf)
    expected = apart.sort(dim=1).values[:, :10].mean(dim=1)
    torch.testing.assert_close(floaters.neighbor_distances(means), expected)
    three = means[:4]
    expected = torch.cdist(three, three).fill_diagonal_(math.inf).sort(dim=1).values[:, :3].mean(dim=1)
    torch.testing.assert_close(floaters.neighbor_distances(three), expected)


def test_neighbors_of_many_are_looked_for_among_an_even_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(floaters, "MAX_REFERENCES", 64)
    monkeypatch.setattr(floaters, "CHUNK", 50)
    means = torch.rand(190, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    apart = torch.cdist(means, means[::3])
    for row in range(0, 190, 3):
        apart[row, row // 3] = math.inf
    nearest = round(math.sqrt(190) / 3)
    torch.testing.assert_close(floaters.neighbor_distances(means), apart.sort(dim=1).values[:, :nearest].mean(dim=1))


@pytest.mark.parametrize(
    ("value", "fine"),
    [(0, True), (0.5, True), (9.9e11, True), (1e12, False), (-1e-9, False), (True, False), ("1", False)],
)
def test_a_checkpoint_has_spent_a_time(value: object, fine: bool) -> None:
    checkpoint = Checkpoint(Path("a"), {}, {"seconds": value})
    assert checkpoint.seconds("cpu_seconds") == 0.0
    if fine:
        assert checkpoint.seconds("seconds") == value
    else:
        with pytest.raises(InputError, match="has seconds"):
            checkpoint.seconds("seconds")


def test_numbers_of_a_checkpoint_are_checked_to_their_bounds() -> None:
    assert [trainer._whole("a", value, 5) for value in (0, 5)] == [0, 5]
    for wrong in (-1, 6, True, 1.0, "1", None):
        with pytest.raises(ValueError, match="a"):
            trainer._whole("a", wrong, 5)
    order = torch.tensor([0, 2, 1])
    assert torch.equal(trainer._views(order, 3), order)
    for broken in (torch.tensor([0, 3]), torch.tensor([-1]), order.int(), order[None]):
        with pytest.raises(ValueError, match="order of the epoch"):
            trainer._views(broken, 3)
    good = {"a": None, "b": 1, "c": -2.5, "d": 9.9e299}
    assert trainer._numbers(good) == good
    for wrong in (True, "1", math.nan, math.inf, 1e300):
        with pytest.raises(ValueError, match="x"):
            trainer._numbers({"x": wrong})


def test_every_end_has_a_code_and_a_line() -> None:
    ends = [(KeyboardInterrupt(), 130), (OSError(28, "full"), 3), (InputError("x"), 3), (NumericalError("x"), 4)]
    ends += [(GsoptError("x"), 1), (ZeroDivisionError("x"), 1)]
    assert [run_directory.exit_code(error) for error, _ in ends] == [code for _, code in ends]
    assert run_directory.describe(ZeroDivisionError("x")) == "ZeroDivisionError: x"
    assert run_directory.describe(InputError("x")) == "x"
    assert "--resume" in run_directory.describe(KeyboardInterrupt())


@pytest.mark.parametrize(("step", "every", "due"), [(10, 5, True), (11, 5, False), (10, 0, False), (0, 5, True)])
def test_what_comes_every_so_often_is_due_at_its_multiples(step: int, every: int, due: bool) -> None:
    assert loop.is_due(step, every) == due


def test_progress_tells_what_is_left_at_the_present_speed() -> None:
    told: dict[str, Any] = {}
    means = SimpleNamespace(loss=0.25, psnr=12.34567)
    running: Any = SimpleNamespace(
        means=means, step=40, model=[None] * 7, plan=SimpleNamespace(schedule=SimpleNamespace(iterations=100))
    )
    directory: Any = SimpleNamespace(emit=lambda kind, **fields: told.update(fields, kind=kind))
    clock: Any = SimpleNamespace(rate=lambda step: 8.0, seconds=lambda: 1.23456, cpu_seconds=lambda: 2.34567)
    loop._report_progress(running, directory, clock)
    assert told == {
        "kind": "progress", "step": 40, "total": 100, "loss": 0.25, "psnr": 12.346, "n": 7,
        "steps_per_second": 8.0, "eta_seconds": 7.5, "seconds": 1.235, "cpu_seconds": 2.346,
    }  # fmt: skip
    clock.rate = lambda step: 0.0
    means.psnr = None
    loop._report_progress(running, directory, clock)
    assert (told["eta_seconds"], told["psnr"]) == (None, None)
    told.clear()
    means.loss = None
    loop._report_progress(running, directory, clock)
    assert told == {}


def test_progress_is_due_half_a_second_after_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [10.0]
    monkeypatch.setattr(loop.time, "perf_counter", lambda: now[0])
    clock = loop.Clock(0, 2.0, 0.0)
    assert clock.seconds() == 2.0
    for later, due in ((0.49, False), (0.5, True)):
        now[0] = 10.0 + later
        assert clock.is_due() == due
    clock.rate(1)
    assert not clock.is_due()


def test_the_memory_of_a_gpu_that_ends_names_the_step_and_the_last_good_state(tmp_path: Path) -> None:
    with pytest.raises(NumericalError, match="No checkpoint was written yet"), loop.gpu_memory(7, tmp_path):
        raise torch.OutOfMemoryError("CUDA out of memory")
    (tmp_path / "step_000005.safetensors").touch()
    told = r"ended in step 8: .*last good state is .*step_000005\.safetensors"
    with pytest.raises(NumericalError, match=told), loop.gpu_memory(7, tmp_path):
        raise torch.OutOfMemoryError("CUDA out of memory")
    with pytest.raises(RuntimeError, match="another"), loop.gpu_memory(7, tmp_path):
        raise RuntimeError("another")


@pytest.mark.parametrize("guided", [False, True])
def test_the_memory_of_a_gpu_is_that_of_its_largest_view_and_all_targets(
    monkeypatch: pytest.MonkeyPatch, guided: bool
) -> None:
    sizes = [(4, 5), (6, 7), (2, 9)]
    views = [SimpleNamespace(camera=SimpleNamespace(width=w, height=h)) for w, h in sizes]
    run: Any = SimpleNamespace(
        target_cache_mb=1.0,
        density=SimpleNamespace(max_gaussians=1000),
        schedule=SimpleNamespace(max_sh_degree=2),
    )
    backend: Any = SimpleNamespace(name="cuda", device=torch.device("meta"))
    expected = Memory.of(1000, 2, 42, 16 * (20 + 42 + 18), PRIOR_BYTES if guided else 0)
    free = [expected.total]
    monkeypatch.setattr(loop, "free_bytes", lambda device: free[0])
    args: Any = (TrainConfig(), run, SimpleNamespace(drawn=views), backend, object() if guided else None)
    assert loop.require_memory(*args) == {"memory_mb": round(expected.total / 1e6)}
    free[0] -= 1
    with pytest.raises(NumericalError, match="--max-gaussians"):
        loop.require_memory(*args)
    run.target_cache_mb, free[0] = 1e-4, expected.total
    assert Memory.of(1000, 2, 42, 100).total < expected.total
    loop.require_memory(*args)
    reference: Any = SimpleNamespace(name="reference", device=torch.device("cpu"))
    assert loop.require_memory(*args[:3], reference, None) is None


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="Linux tells the peak of a process")
def test_the_peak_of_memory_is_that_of_this_process() -> None:
    resource = pytest.importorskip("resource")
    peak = loop.peak_memory_mb()
    assert peak is not None
    assert peak == pytest.approx(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, rel=0.5)
    assert 50 < peak < 50_000


def test_a_cell_holds_its_lower_bound_and_not_its_upper_one() -> None:
    cell = Cell("00", (0.0, -math.inf), (1.0, 5.0), (0.1, 0.2), ("a",), 3)
    places = torch.tensor([[0.0, -9], [1.0, 0], [0.5, 5], [-0.1, 5.1], [1.05, 0], [1.1, 0]], dtype=torch.float64)
    assert cell.holds(places).tolist() == [True, False, False, False, False, False]
    assert cell.holds(places, wide=True).tolist() == [True, True, True, True, True, False]


def test_the_row_of_a_cell_needs_views_gaussians_and_two_bounds() -> None:
    row = {"low": [None, 0], "high": [1, None], "margin": [0, 0], "views": ["a"], "max_gaussians": 1}
    assert cell_plan._cell(3, row) == Cell("03", (-math.inf, 0.0), (1.0, math.inf), (0.0, 0.0), ("a",), 1)
    for wrong in ({"max_gaussians": 0}, {"max_gaussians": True}, {"views": []}, {"views": "a"}):
        with pytest.raises(ValueError, match="no views or Gaussians"):
            cell_plan._cell(3, {**row, **wrong})
    for wrong in ({"low": [0]}, {"high": [1, 2, 3]}, {"margin": [0, math.nan]}):
        with pytest.raises(ValueError, match="2 numbers are needed"):
            cell_plan._cell(3, {**row, **wrong})


def test_the_stages_of_cells_are_shares_of_one_run(tmp_path: Path) -> None:
    """A coarse run and a polish of three tenths, a cell of eight tenths of the steps by its share of the views."""
    config = TrainConfig(iterations=1001, density=DensityConfig(refine_start=100))
    coarse = stages.coarse_stage(config, 4, 1001).config
    assert (coarse.iterations, coarse.density.max_gaussians, coarse.density.refine_start) == (301, 251, 30)
    assert coarse.optimizer.sh_degree_every == math.ceil(0.3 * MANY.sh_degree_every)
    cell = Cell("07", (0.0, 0.0), (1.0, 1.0), (0.0, 0.0), ("a", "b", "c"), 77)
    fine = stages.cell_stage(config, cell, 12, tmp_path)
    assert (fine.name, fine.config.iterations, fine.config.density.max_gaussians) == ("cells/07", 201, 77)
    assert (fine.config.density.refine_start, fine.config.density.reset_every) == (0, 0)
    assert (fine.config.schedule.coarse_until, fine.config.optimizer.sh_degree_every) == ((), 1)
    assert fine.config.cell.start == str(tmp_path / "cells/07/start.ply")
    polish = stages.polish_stage(config, 999, tmp_path).config
    assert (polish.iterations, polish.density.max_gaussians, polish.density.refine_stop) == (301, 999, 0)
    assert stages.coarse_stage(TrainConfig(iterations=1), 2, 1).config.iterations == 1


def test_the_share_of_a_window_is_that_of_its_pixels() -> None:
    colors = torch.zeros(3, 4, 3)
    target = Target(ring(1, 1.0)[0], colors, None, (6, 8))
    assert target.share == 0.25
    assert list(target.images) == ["colors"]


def test_work_without_settings_is_not_resumed(tmp_path: Path) -> None:
    """An empty folder may be: the run begins there."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "splat.ply").touch()
    with (
        pytest.raises(InputError, match=r"has no config\.json, so it cannot be resumed"),
        run_directory.opened(tmp_path / "run", TrainConfig(), True, None),
    ):
        pass
    assert not (tmp_path / "run" / "config.json").exists()
    with run_directory.opened(tmp_path / "empty", TrainConfig(), True, None):
        assert (tmp_path / "empty" / "config.json").is_file()


def test_a_completed_scene_has_the_steps_of_twice_its_photos(dataset: Path) -> None:
    """A guessed view stands beside every photo; with a body nobody asks for a network."""
    config = tiny_config(dataset, iterations=100, sparse=SparseConfig(steps_per_view=7))
    config = replace(config, guidance=GuidanceConfig())
    whole = load_scene(config.data)
    few = replace(whole, train=whole.train[:2])
    completed = replace(few, guessed=whole.train[2:4])
    assert [RunPlan.of(config, one).schedule.iterations for one in (few, completed)] == [14, 28]
    with_body: Any = replace(few, body=object())
    assert [RunPlan.of(config, one).prior.reason for one in (few, with_body)] == [NOT_ASKED, LIBRARY]
    schedule = replace(config.schedule, bands="residual")
    assert [RunPlan.of(one, few).residual_bands for one in (config, replace(config, schedule=schedule))] == [
        False,
        True,
    ]
