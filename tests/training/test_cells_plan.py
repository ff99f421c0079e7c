"""Laws of the cells: they part the ground without gaps, hold equally many Gaussians, and their plan is not trusted."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud, tiny_config, write_dataset

from gsopt.config.train import DensityConfig, SparseConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, UsageError
from gsopt.formats.ply import save_ply
from gsopt.raster.api import make_backend
from gsopt.training.cells import divide as divide_module
from gsopt.training.cells import size as size_module
from gsopt.training.cells.divide import divide, ground_axes, relevant, split
from gsopt.training.cells.plan import Cell, CellPlan, read_plan, sha256
from gsopt.training.cells.size import cell_sizes, sizes_of
from gsopt.training.cells.stages import coarse_stage, polish_stage
from gsopt.training.estimate import PIXEL_BYTES, of_sizes
from gsopt.training.plan import RunPlan


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("cells") / "cloud", train=6, test=1)


def big(data: Path, **changes: Any) -> TrainConfig:
    """A run that is not one of few views."""
    return replace(tiny_config(data), sparse=SparseConfig(below_views=0), **changes)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_cells_cover_the_plane_once_and_hold_equally_many(count: int) -> None:
    places = torch.randn(700, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(count)) * 3
    cells = [Cell("", *box, (0.5, 0.5), (), 1) for box in split(places, count)]
    anywhere = torch.cat([places, 1e6 * places, torch.tensor([box.low for box in cells if math.isfinite(box.low[0])])])
    inside = torch.stack([cell.holds(anywhere) for cell in cells])
    assert (inside.sum(0) == 1).all()
    held = inside[:, :700].sum(1)
    assert int(held.max() - held.min()) <= math.ceil(math.log2(count))  # a rounding per halving
    assert all(bool((cell.holds(anywhere, wide=True) | ~cell.holds(anywhere)).all()) for cell in cells)


def test_a_model_of_fewer_places_than_cells_is_refused() -> None:
    for places in (torch.zeros(9, 2), torch.zeros(0, 2), torch.rand(3, 2)):
        with pytest.raises(InputError, match="Lower --cells"):
            split(places.double(), 4)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_as_many_places_as_cells_are_enough(count: int) -> None:
    places = torch.arange(2.0 * count).reshape(count, 2).double()
    cells = [Cell("", *box, (0.5, 0.5), (), 1) for box in split(places, count)]
    assert [int(cell.holds(places).sum()) for cell in cells] == [1] * count


def test_a_view_belongs_to_the_cells_that_draw_it_and_no_cell_goes_without() -> None:
    shares = torch.tensor([0.5, 0.04, 0.06] * 4)
    assert relevant(shares).tolist() == [True, False, True] * 4
    few = torch.linspace(0, 0.04, 20)
    assert relevant(few).nonzero()[:, 0].tolist() == list(range(12, 20))


def test_a_scene_is_divided_by_what_its_views_see(data: Path) -> None:
    scene, coarse = load_scene(str(data)), cloud(80, 4)
    found = divide(coarse, "0" * 64, scene.train, make_backend("cpu", 1), 2, 1000)
    places = found.plan.places(coarse.means)
    wide = [cell.holds(places, wide=True) for cell in found.plan.cells]
    assert all(bool(~(inside & outside).any()) for inside, outside in zip(wide, found.surroundings, strict=True))
    assert all(
        cell.max_gaussians == math.ceil(1000 * int(w.sum()) / 80)
        for cell, w in zip(found.plan.cells, wide, strict=True)
    )
    assert all(set(cell.views) <= {view.name for view in scene.train} and cell.views for cell in found.plan.cells)
    axes = ground_axes(scene.train)
    assert torch.allclose(axes @ axes.T, torch.eye(2, dtype=torch.float64), atol=1e-6)
    assert float(axes[:, 2].abs().max()) < 0.1  # the cameras stand around the z axis


HOSTILE: dict[str, Any] = {
    "another version": lambda d: d.update(version=2),
    "no version": lambda d: d.pop("version"),
    "another coarse run": lambda d: d.update(coarse="0" * 64),
    "one cell less": lambda d: d["cells"].pop(),
    "no list of cells": lambda d: d.update(cells=3),
    "a cell as text": lambda d: d["cells"].__setitem__(0, "x"),
    "a view of another scene": lambda d: d["cells"][0].update(views=["../../secret.png"]),
    "views as text": lambda d: d["cells"][0].update(views="r_0.png"),
    "no views": lambda d: d["cells"][0].update(views=[]),
    "no Gaussians": lambda d: d["cells"][0].update(max_gaussians=0),
    "Gaussians as text": lambda d: d["cells"][0].update(max_gaussians="9"),
    "a bound as text": lambda d: d["cells"][0].update(low=["a", None]),
    "three bounds": lambda d: d["cells"][0].update(low=[0, 0, 0]),
    "a bound of 400 digits": lambda d: d["cells"][0].update(high=[10**400, None]),
    "a margin that is none": lambda d: d["cells"][0].update(margin=[math.nan, 0]),
    "one axis": lambda d: d["ground"].pop(),
    "an axis of two": lambda d: d["ground"].__setitem__(0, [1, 0]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_plan_is_one_clear_line(name: str, tmp_path: Path) -> None:
    coarse, path = tmp_path / "coarse.ply", tmp_path / "plan.json"
    save_ply(coarse, cloud(5, 1))
    cells = (
        Cell("00", (-math.inf, -math.inf), (0.1, math.inf), (0.2, 0.3), ("a", "b"), 7),
        Cell("01", (0.1, -math.inf), (math.inf, math.inf), (0.2, 0.3), ("b",), 8),
    )
    plan = CellPlan(sha256(coarse), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), cells)
    plan.write(path)
    assert read_plan(path, coarse, {"a": 1, "b": 1}, 2) == plan
    document = json.loads(path.read_text())
    HOSTILE[name](document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"plan\.json does not fit this run: [^\n]*Remove it") as refusal:
        read_plan(path, coarse, {"a": 1, "b": 1}, 2)
    assert "\n" not in str(refusal.value)


def sizes(config: TrainConfig) -> Any:
    scene = load_scene(config.data)
    return cell_sizes(config, RunPlan.of(config, scene), scene)


def test_cells_that_make_no_sense_are_refused(data: Path) -> None:
    with pytest.raises(UsageError, match="few enough for one run"):
        sizes(replace(tiny_config(data), cells="2"))
    with pytest.raises(UsageError, match="at most the 6 input views, got 7"):
        sizes(big(data, cells="7"))
    one = big(data, cells="2")
    with pytest.raises(UsageError, match="at most the 1 input views"):
        sizes(replace(one, data=replace(one.data, views=1)))


def test_cells_that_do_not_fit_are_refused_with_what_would(data: Path) -> None:
    huge = big(data, cells="2", density=DensityConfig(max_gaussians=1_000_000))
    with pytest.raises(
        InputError, match=r"2 cells need about 2\.\d GB each, there are 1\.2 GB. Give --cells (\d), "
    ) as refusal:
        sizes(replace(huge, max_memory="1.2GB"))
    enough = str(refusal.value).split("--cells ")[1][0]
    found = sizes(replace(huge, cells=enough, max_memory="1.2GB"))
    assert found.cell.memory <= 1.2e9 < found.polish.memory
    assert not found.polished
    assert "no joint polish" in str(found)
    assert sizes(replace(huge, cells="auto", max_memory="1.2GB")).count == int(enough)
    assert sizes(replace(huge, cells="auto", max_memory="9GB")).count == 2
    with pytest.raises(InputError, match="fewer Gaussians"):
        sizes(replace(huge, cells="auto", max_memory="350MB"))


def test_the_wider_axis_is_cut_whatever_a_few_lie_out_there() -> None:
    """10 times as wide along x; two places in a hundred lie a thousand times farther out along y."""
    places = torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    places[:, 0] *= 10
    places[:2, 1], places[2:4, 1] = 1e3, -1e3
    (low, high), (next_low, next_high) = split(places, 2)
    assert low == (-math.inf, -math.inf)
    assert high[1] == next_high[1] == math.inf
    assert high[0] == next_low[0] == pytest.approx(float(places[:, 0].median()), abs=0.2)
    turned = split(places.flip(1), 2)
    assert turned[0][1] == (math.inf, high[0])
    assert turned[1][0] == (-math.inf, high[0])
    three = split(places, 3)
    held = [int(((places >= torch.tensor(a)) & (places < torch.tensor(b))).all(1).sum()) for a, b in three]
    assert held == [66, 67, 67]


def test_the_ground_is_at_right_angles_to_the_cameras_common_up(data: Path) -> None:
    axes = ground_axes(load_scene(data).train)
    torch.testing.assert_close(axes @ axes.T, torch.eye(2, dtype=torch.float64), atol=1e-6, rtol=0)
    assert float(axes[:, 2].abs().max()) < 0.05  # the cameras of this scene have z up
    assert float(axes[0].abs().max()) > 0.99


def test_a_cell_draws_its_share_of_what_a_view_shows() -> None:
    weights, wide = torch.tensor([0.01, 0.03, 0.04]), torch.tensor([[True, False, True], [False, True, False]])
    assert divide_module._shares(weights, wide).tolist() == pytest.approx([5 / 8, 3 / 8])
    assert divide_module._shares(torch.zeros(3), wide).tolist() == [0, 0]


def test_a_view_with_exactly_the_relevant_share_belongs_to_a_cell() -> None:
    shares = torch.full((20,), float(divide_module.RELEVANT))
    assert relevant(shares).all()
    most = torch.cat([torch.full((divide_module.FEWEST_VIEWS,), 0.5), torch.full((9,), 0.01)])
    assert relevant(most).sum() == divide_module.FEWEST_VIEWS


def test_memory_is_estimated_for_the_largest_view(data: Path) -> None:
    config = big(data)
    scene = load_scene(str(data))
    plan = RunPlan.of(config, scene)
    large, *others = scene.train
    smaller = replace(scene, train=tuple(replace(view, camera=view.camera.resized(8, 8)) for view in others))
    mixed = replace(smaller, train=(*smaller.train, large))
    for part in ("coarse", "cell", "polish", "whole"):
        few, many = (getattr(sizes_of(2, config, plan, one, None, 0), part).memory for one in (smaller, mixed))
        assert many - few == PIXEL_BYTES * (large.camera.width * large.camera.height - 64)


def test_time_is_estimated_for_the_steps_that_a_stage_takes(data: Path) -> None:
    config = big(data, iterations=100)
    scene = load_scene(str(data))
    plan = RunPlan.of(config, scene)
    found, budget = sizes_of(2, config, plan, scene, None, 0), plan.density.max_gaussians
    degree, pixels = plan.schedule.max_sh_degree, max(view.camera.width * view.camera.height for view in scene.train)
    coarse, polish = coarse_stage(config, 2, budget).config, polish_stage(config, budget, data).config
    assert (coarse.iterations, polish.iterations) == (30, 30)
    assert found.coarse.seconds == of_sizes(math.ceil(budget / 2), degree, pixels, 0, coarse.iterations).seconds
    assert found.polish.seconds == of_sizes(budget, degree, pixels, 0, polish.iterations).seconds


@pytest.mark.parametrize(("count", "steps"), [(1, 80), (2, 80), (4, 40), (5, 32)])
def test_a_cell_is_estimated_with_its_margin_and_by_two_cells_per_view(count: int, steps: int, data: Path) -> None:
    """Eight tenths of 100 steps where all views see it, and three tenths more Gaussians than its own."""
    config, scene = big(data, iterations=100), load_scene(str(data))
    plan = RunPlan.of(config, scene)
    degree, budget, pixels = plan.schedule.max_sh_degree, plan.density.max_gaussians, 24 * 24
    part = math.ceil(budget / count)
    found = sizes_of(count, config, plan, scene, None, 7)
    assert found.count == count
    assert found.coarse == of_sizes(part, degree, pixels, 7, 30)
    assert found.cell == of_sizes(math.ceil(1.3 * part), degree, pixels, 7, steps, frozen=part)
    assert found.polish == of_sizes(budget, degree, pixels, 7, 30, growing=False)
    assert found.whole == of_sizes(budget, degree, pixels, 7, 100)
    limits = (None, found.polish.memory, found.polish.memory - 1)
    polished = [sizes_of(count, config, plan, scene, limit, 7).polished for limit in limits]
    assert polished == [True, True, False]


def test_as_many_cells_as_input_views_are_allowed(data: Path) -> None:
    assert sizes(big(data, cells="6")).count == 6


def test_cells_fit_up_to_the_last_byte_of_the_larger_run() -> None:
    for coarse, cell in ((700, 800), (800, 700)):
        pair: Any = SimpleNamespace(coarse=SimpleNamespace(memory=coarse), cell=SimpleNamespace(memory=cell))
        assert [size_module._fits(pair, limit) for limit in (None, 800, 799)] == [True, True, False]


@pytest.mark.parametrize(("polished", "time", "memory"), [(True, "0:01:15", 900), (False, "0:01:10", 800)])
def test_the_sizes_of_cells_add_up_with_the_polish_only_where_there_is_one(
    polished: bool, time: str, memory: int
) -> None:
    coarse, cell, polish, whole = (
        SimpleNamespace(memory=memory, seconds=seconds) for memory, seconds in ((700, 10), (800, 20), (900, 5), (1, 2))
    )
    found = size_module.Sizes(3, coarse, cell, polish, whole, polished)  # type: ignore[arg-type]
    assert found.memory == memory
    assert f", {time} of one core" in str(found)
    assert ("no joint polish" in str(found)) == (not polished)


def test_a_side_leaves_a_twentieth_out_at_either_end() -> None:
    x = torch.arange(40.0).double()
    places = torch.stack([x, 3 * x.flip(0)], dim=1)
    assert divide_module._side(places).tolist() == [37 - 2, 3 * (37 - 2)]
    assert divide_module._side(places[:19]).tolist() == [18, 54]


def test_cells_overlap_by_a_tenth_of_the_narrowest(data: Path) -> None:
    coarse = cloud(80, 4)
    found = divide(coarse, "0" * 64, load_scene(str(data)).train, make_backend("cpu", 1), 2, 1000).plan
    places = found.places(coarse.means)
    widths = []
    for cell in found.cells:
        own = places[cell.holds(places)].sort(dim=0).values
        cut = len(own) // 20
        widths.append(own[len(own) - 1 - cut] - own[cut])
    narrowest = torch.stack(widths).amin(0)
    assert [cell.margin for cell in found.cells] == [pytest.approx(tuple((narrowest / 10).tolist()))] * 2
