"""`gsopt bench`: the test scenes, the sums of the figures, and whole-or-nothing result files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from gsopt import cli
from gsopt.benchmark import result_files, schema
from gsopt.benchmark.charts import Axis, Series, chart
from gsopt.benchmark.growth import fitted_exponent
from gsopt.benchmark.kernels import Case, Iteration
from gsopt.benchmark.markdown import replace_block
from gsopt.benchmark.stopwatch import spread
from gsopt.benchmark.surface_scene import FLATNESS, surface_scene
from gsopt.errors import InputError, UsageError
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings

ROOT = Path(__file__).resolve().parents[2]
CASE = "48x32/2k"


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result file of one small case on one and on two threads."""
    file = tmp_path_factory.mktemp("bench") / "kernels.json"
    argv = ["bench", "kernels", "--json", str(file), "--case", CASE, "--threads", "1,2", "--repetitions", "3"]
    assert cli.main(argv) == 0
    return file


def test_the_scene_is_wholly_in_view_flat_and_reproducible() -> None:
    gaussians, camera = surface_scene(3000, 64, 64)
    again, _ = surface_scene(3000, 64, 64)
    assert len(gaussians.validate()) == 3000
    assert all(torch.equal(tensor, getattr(again, name)) for name, tensor in gaussians.items())
    thinnest, widest = gaussians.scales.amin(dim=1), gaussians.scales.amax(dim=1)
    torch.testing.assert_close(thinnest / widest, torch.full((3000,), FLATNESS))
    frame = make_backend("cpu", 1).forward(gaussians, camera, RasterSettings())
    assert bool((frame.radii > 0).all())


def test_one_record_per_case_and_number_of_threads(measured: Path) -> None:
    document = result_files.read(measured)
    assert [(record["case"], record["threads"]) for record in document["cases"]] == [(CASE, 1), (CASE, 2)]
    assert document["cases"][0]["useful_pairs"] == document["cases"][1]["useful_pairs"] > 0


def test_the_stages_make_up_the_iteration(measured: Path) -> None:
    record = result_files.read(measured)["cases"][0]
    stages = sum(stage["wall_ms"]["median"] for stage in record["stages"].values())
    assert len(record["stages"]) == 7
    assert 0 < stages <= record["wall_ms"]["median"] + 3 * record["wall_ms"]["iqr"]
    assert 0 < record["lane_use"] <= 1


def test_useful_pairs_are_counted_as_the_image_model_says() -> None:
    iteration = Iteration(Case.parse("16x16/30"), 1)
    g, camera = iteration.model.gaussians.to(torch.float64), iteration.camera
    from gsopt.raster.backend import ALPHA_MIN, TRANSMITTANCE_MIN
    from gsopt.raster.reference import hard_threshold, raw_alphas, splat, transmittances

    splats = splat(g, camera.to(torch.float64), iteration.settings, torch.zeros(len(g), 2, dtype=torch.float64))
    y, x = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(16) + 0.5, indexing="ij")
    deltas = torch.stack([x, y], dim=-1).view(-1, 1, 2) - splats.means2d
    alphas = hard_threshold(raw_alphas(deltas, splats.conics, splats.opacities))
    useful = (alphas >= ALPHA_MIN) & (transmittances(alphas)[0] > TRANSMITTANCE_MIN)
    assert iteration.work()[2] == int(useful.sum()) > 100


def test_other_cases_are_kept_and_the_same_case_is_replaced(measured: Path, tmp_path: Path) -> None:
    document = result_files.read(measured)
    file = tmp_path / "kernels.json"
    file.write_bytes(measured.read_bytes())
    changed = {**document["cases"][0], "repetitions": 99}
    other = {**document["cases"][0], "case": "8x8/1", "width": 8, "height": 8}
    base = {key: document[key] for key in ("command", "machine", "calibration")}
    result_files.update(file, {**base, "cases": [changed, other]})
    kept = result_files.read(file)["cases"]
    assert [(r["case"], r["threads"], r["repetitions"]) for r in kept] == [("8x8/1", 1, 3), (CASE, 1, 99), (CASE, 2, 3)]


def test_what_departs_from_the_schema_is_not_written(measured: Path, tmp_path: Path) -> None:
    document = result_files.read(measured)
    file = tmp_path / "kernels.json"
    broken: dict[str, Any] = {**document, "cases": [{**document["cases"][0], "useful_pairs": "many"}]}
    with pytest.raises(InputError, match=r"`result.cases\[0\].useful_pairs` must be int, got 'many'"):
        result_files.update(file, {key: value for key, value in broken.items() if key != "version"})
    assert not file.exists()
    with pytest.raises(InputError, match="must be float, got nan"):
        schema.require({"median": float("nan"), "iqr": 0.0}, schema.SPREAD)
    file.write_text("{}")
    with pytest.raises(InputError, match="must be the keys"):
        result_files.read(file)


def test_the_committed_results_keep_the_schema() -> None:
    result_files.read(ROOT / "experiments" / "results" / "kernels.json")


def test_a_page_is_drawn_from_the_file_alone(measured: Path, tmp_path: Path) -> None:
    page = tmp_path / "performance.md"
    (tmp_path / "img").mkdir()
    page.write_text("above\n<!-- begin kernels -->\nold\n<!-- end kernels -->\nbelow\n")
    assert cli.main(["bench", "draw", "--json", str(measured), "--page", str(page)]) == 0
    text = page.read_text()
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "old" not in text
    assert f"| {CASE} | 1 |" in text
    with pytest.raises(InputError, match="no pair of lines"):
        replace_block(page, "other", "")


@pytest.mark.parametrize("name", ["800x800", "0x8/1k", "axb/1", "8x8/0", "99999x1/1"])
def test_a_case_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="`--case`"):
        Case.parse(name)


def test_the_exponent_is_that_of_a_power_law() -> None:
    assert fitted_exponent([(x, 7 * x**0.75) for x in (1, 10, 100, 1000)]) == pytest.approx(0.75, abs=1e-3)


def test_the_spread_is_the_median_and_the_distance_of_the_quartiles() -> None:
    assert spread([0.001, 0.002, 0.003, 0.004, 0.005]) == {"median": 3.0, "iqr": 2.0}


def test_a_chart_shows_every_point_that_its_axes_can_hold() -> None:
    svg = chart("t <", Axis("x", log=True), Axis("y"), [Series("a & b", [(1, 1), (10, 2), (0, 3), (5, float("nan"))])])
    assert svg.count('r="3.5"') == 2
    assert "t &lt;" in svg
    assert "a &amp; b" in svg
    assert "nothing measured" in chart("t", Axis("x"), Axis("y"), [])


def test_the_record_is_json(measured: Path) -> None:
    assert json.loads(measured.read_text())["command"].startswith("gsopt bench kernels --json")
