"""Lengths of a run are those of its scene, and its scale and origin travel with every file that can carry them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from finished_runs import HEIGHT, WIDTH, make_run, splats
from hypothesis import given
from hypothesis import strategies as st

from gsopt.cli import main
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats
from gsopt.formats.units import UNKNOWN, Units, read_units, units_from_comments, units_from_notes
from gsopt.gaussians import Gaussians
from gsopt.geometry.projection import project
from gsopt.results.finished_run import open_run
from gsopt.results.measure import located, meters, units_of

pytest.importorskip("scipy")

SCALED = Units(0.125, (500000.5, -4e6, 12.0))
CARRIERS = (".ply", ".compressed.ply", ".sog", ".glb")


def opaque() -> Gaussians:
    """One opaque splat at a known place."""
    return Gaussians(
        means=torch.tensor([[0.3, -0.2, 0.1]]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(0.2)),
        logit_opacities=torch.tensor([5.0]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )


@pytest.mark.parametrize("suffix", CARRIERS)
def test_scale_and_origin_survive_a_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    save_splats(path, splats(), units=SCALED)
    assert read_units(path) == SCALED
    assert len(load_splats(path)) == 12
    save_splats(path, splats())
    assert read_units(path) == UNKNOWN


@pytest.mark.parametrize("suffix", CARRIERS)
def test_a_file_of_a_scene_that_nobody_measured_keeps_its_bytes(tmp_path: Path, suffix: str) -> None:
    save_splats(tmp_path / f"a{suffix}", splats())
    save_splats(tmp_path / f"b{suffix}", splats(), units=UNKNOWN)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@given(
    st.floats(min_value=1e-12, max_value=1e12),
    st.tuples(*[st.floats(min_value=-1e12, max_value=1e12, allow_subnormal=False)] * 3),
)
def test_notes_and_comments_are_exact(scale: float, origin: tuple[float, float, float]) -> None:
    units = Units(scale, origin)
    assert units_from_comments(units.comments()) == units == units_from_notes(json.loads(json.dumps(units.notes())))


@pytest.mark.parametrize(
    "notes",
    [
        None,
        [],
        {"meters_per_unit": "1"},
        {"meters_per_unit": -1},
        {"meters_per_unit": 0},
        {"meters_per_unit": True},
        {"meters_per_unit": 10**400},
        {"origin": [1, 2]},
        {"origin": [1, 2, None]},
        {"origin": "abc"},
    ],
)
def test_notes_that_mean_nothing_count_as_absent(notes: object) -> None:
    assert units_from_notes(notes) == UNKNOWN
    assert units_from_comments(["Meters per unit: nan", "Origin: 1 2", "origin: a b c"]) == UNKNOWN


def test_a_pixel_names_the_surface_that_it_shows(tmp_path: Path) -> None:
    run = open_run(make_run(tmp_path, learned=opaque()))
    view = load_scene(run.config.data).train[1]
    column, row, _ = (float(value) for value in project(view.camera, opaque().means))
    found = located(run, f"r_1@{column},{row}")
    assert float((found - opaque().means[0]).norm()) < 1e-4


def test_a_known_length_gives_the_run_its_scale_and_exports_carry_it(tmp_path: Path, capsys) -> None:
    run = make_run(tmp_path)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"origin": [100.0, 200.0, 0.0]}))
    measure = ["measure", str(run), "--from=-1,0,0", "--to", "1,0,0"]
    assert main(measure) == 0
    assert capsys.readouterr().out == "2 scene units\n"
    assert main([*measure, "--unit-length", "50cm"]) == 0
    assert "1 scene unit is 0.25 m" in capsys.readouterr().out
    assert main(["measure", str(run), "--from", "0,0,0", "--to=0,3,4"]) == 0
    assert capsys.readouterr().out == "5 scene units, 1.25 m\n"
    wanted = Units(0.25, (100.0, 200.0, 0.0))
    assert units_of(run) == wanted
    for first, second in zip(CARRIERS, (*CARRIERS[1:], ".ply"), strict=True):
        assert main(["export", str(run), "-o", str(tmp_path / f"a{first}"), "--force"]) == 0
        assert main(["export", str(tmp_path / f"a{first}"), "-o", str(tmp_path / f"b{second}"), "--force"]) == 0
        assert read_units(tmp_path / f"b{second}") == wanted


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--from", "1,2", "--to", "1,2,3"], 2, "X,Y,Z"),
        (["--from", "absent@1,2", "--to", "1,2,3"], 2, "must name one view"),
        (["--from", "0,0,0", "--to", f"r_0@{WIDTH},{HEIGHT}"], 2, "inside it"),
        (["--from", "0,0,0", "--to", f"r_0@1,{HEIGHT}"], 2, "inside it"),
        (["--from", "0,0,0", "--to", f"r_0@{WIDTH},1"], 2, "inside it"),
        (["--from", "0,0,0", "--to", "r_0@0,0"], 2, "no surface"),
        (["--from", "0,0,0", "--to", "0,0,0", "--unit-length", "1m"], 2, "lie apart"),
        (["--from", "0,0,0", "--to", "0,0,1", "--unit-length", "1"], 2, "one of m, cm"),
        (["--from", "0,0,0", "--to", "0,0,1", "--unit-length", "-1m"], 2, "above 0"),
    ],
)
def test_what_names_no_point_or_length_is_refused_in_one_line(
    tmp_path: Path, capsys, arguments: list[str], code: int, message: str
) -> None:
    run = make_run(tmp_path, learned=opaque())
    assert main(["measure", str(run), *arguments]) == code
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert not (run / "units.json").exists()


@pytest.mark.parametrize("text", ["nothing", "[]", '{"meters_per_unit": "x"}', '{"meters_per_unit": 0}'])
def test_a_broken_note_is_bad_data(tmp_path: Path, capsys, text: str) -> None:
    run = make_run(tmp_path)
    (run / "units.json").write_text(text)
    with pytest.raises(InputError, match=r"units\.json"):
        units_of(run)
    assert main(["export", str(run), "-o", str(tmp_path / "a.ply")]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(("text", "length"), [("0.25m", 0.25), ("25 cm", 0.25), ("10in", 0.254), ("1e3 mm", 1.0)])
def test_lengths_are_read_in_the_usual_units(text: str, length: float) -> None:
    assert meters(text) == pytest.approx(length)
