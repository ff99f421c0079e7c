"""`gsopt bench scenes`: whole runs are evaluated several times, and their Pareto front is found."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt import cli
from gsopt.benchmark import result_files, schema
from gsopt.benchmark.scenes import Task, pareto_front, time_at
from gsopt.cli import bench
from gsopt.config.presets import PRESETS
from gsopt.config.train import DataConfig
from gsopt.errors import InputError, UsageError
from gsopt.training.open_settings import FEW_OF_AN_OBJECT
from gsopt.training.plan import shortened


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A preset of four steps and a grid of two runs of the scene that ships with gsopt, evaluated on two views."""
    file = tmp_path_factory.mktemp("scenes") / "runs.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "draft", {"iterations": 4})
        patch.setattr("gsopt.benchmark.scenes.EVALUATIONS", 2)
        patch.setattr("gsopt.benchmark.scenes.MAX_EVALUATED_VIEWS", 2)
        argv = ["bench", "scenes", "--json", str(file), "-r", "4", "--presets", "draft"]
        assert cli.main([*argv, "--counts", "300", "1k", "--lengths", "3"]) == 0
        assert cli.main([*argv, "--counts", "300", "--lengths", "3", "--missing"]) == 0
    return file


def test_a_preset_is_evaluated_during_its_run_and_the_grid_at_its_end(measured: Path) -> None:
    runs = result_files.read(measured, schema.SCENES)["runs"]
    assert [(run["kind"], run["max_gaussians"], [p["step"] for p in run["points"]]) for run in runs] == [
        ("curve", None, [2, 4]),
        ("grid", 300, [3]),
        ("grid", 1000, [3]),
    ]
    for run in runs:
        times = [point["cpu_seconds"] for point in run["points"]]
        assert 0 < times[0] <= times[-1]
        assert all(0 < point["psnr"] < 100 for point in run["points"])
        assert all(point["gaussians"] <= (run["max_gaussians"] or 10**9) for point in run["points"])


def test_another_measurement_of_the_same_run_replaces_it(measured: Path, tmp_path: Path) -> None:
    file = tmp_path / "runs.json"
    file.write_bytes(measured.read_bytes())
    document = result_files.read(file, schema.SCENES)
    result_files.update_runs(file, "again", document["machine"], {**document["runs"][1], "points": []})
    runs = result_files.read(file, schema.SCENES)["runs"]
    assert len(runs) == 3
    assert runs[-1]["points"] == []


def test_a_page_is_drawn_from_the_file_alone(measured: Path, tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    (tmp_path / "img").mkdir()
    page.write_text("above\n<!-- begin scenes -->\nold\n<!-- end scenes -->\nbelow\n")
    assert cli.main(["bench", "draw", "--json", str(measured), "--page", str(page)]) == 0
    text = page.read_text()
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "| draft | 4 |" in text
    shown = {line.split("(img/")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")}
    assert shown == {path.name for path in (tmp_path / "img").iterdir()}
    assert len(shown) == 3


def test_a_scene_that_holds_out_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        bench.scenes(bench.Scenes(tmp_path / "x.json", tmp_path), [])
    file = tmp_path / "kernels.json"
    file.write_text("[]")
    with pytest.raises(InputError, match="must be dict"):
        cli.bench.draw(cli.bench.Draw(file))


@pytest.mark.parametrize("counts", ["many", "0", "1.5k"])
def test_a_budget_that_is_none_is_refused(counts: str, tmp_path: Path) -> None:
    assert cli.main(["bench", "scenes", "--json", str(tmp_path / "x"), "--counts", counts]) == UsageError.exit_code


def test_a_task_with_a_length_or_a_budget_belongs_to_the_grid() -> None:
    data = DataConfig("scene")
    assert Task("a", data, "high").kind == "curve"
    assert Task("a", data, iterations=5).kind == Task("a", data, max_gaussians=5).kind == "grid"
    assert Task("a", data, "high").config().iterations == PRESETS["high"]["iterations"]
    steps = shortened(Task("a", data, iterations=6000).config(), FEW_OF_AN_OBJECT, 1)
    assert steps == 6000  # a point of the grid is as long as its record says


def test_times_lie_between_two_events() -> None:
    events = [
        {"kind": "progress", "step": 10, "cpu_seconds": 1.0, "seconds": 2.0},
        {"kind": "preview", "step": 15},
        {"kind": "progress", "step": 20, "cpu_seconds": 2.0, "seconds": 6.0},
    ]
    assert time_at(15, events) == (1.5, 4.0)
    assert time_at(5, events) == (0.5, 1.0)
    assert time_at(25, events) == (2.0, 6.0)


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0, 9), st.floats(0, 9)), min_size=1, max_size=12))
def test_nothing_beats_a_point_of_the_front_and_something_beats_the_rest(points: list[tuple[float, float]]) -> None:
    kept = pareto_front(points)
    for cost, quality in points:
        beaten = any(c <= cost and q >= quality and (c, q) != (cost, quality) for c, q in points)
        assert ((cost, quality) in kept) == (not beaten)
    assert kept == sorted(kept)
