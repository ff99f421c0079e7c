"""The report's section about cameras: there when poses were found or corrected, and no way in for hostile files."""

from __future__ import annotations

import json
from pathlib import Path

from finished_runs import make_run
from PIL import Image

from gsopt.results.report import write_report
from gsopt.results.report.cameras_section import cameras_section

EVIL = "<script>alert('x')</script>"


def cameras_html(run: Path) -> str:
    messages: list[str] = []
    text = cameras_section(run.parent / "data", run, messages)
    return text + "".join(messages)


def test_poses_that_were_given_are_not_talked_about(tmp_path: Path) -> None:
    assert cameras_html(make_run(tmp_path, train=1, test=0)) == ""


def test_what_sfm_said_and_drew_stands_on_the_page(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=0)
    lines = ["18 of 20 photos placed (incremental)", f"  not placed: {EVIL}"]
    (tmp_path / "data/sfm.json").write_text(json.dumps({"report": lines}))
    Image.new("RGB", (60, 40), (196, 78, 36)).save(tmp_path / "data/sfm.png")
    page = write_report(run).read_text(encoding="utf-8")
    assert "<h2>Cameras</h2>" in page
    assert "18 of 20 photos placed (incremental)" in page
    assert 'alt="Cameras and points"' in page
    assert EVIL not in page


def test_corrected_poses_are_summed_up(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=0)
    views = [{"turned_degrees": value} for value in (0.1, 0.5, 0.3)]
    (run / "poses.json").write_text(json.dumps({"views": views}))
    assert "turned 3 input views by 0.300 degrees (median), 0.500 at most" in cameras_html(run)


def test_broken_files_are_named_and_hostile_values_vanish(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=0)
    (tmp_path / "data/sfm.json").write_text("{")
    (tmp_path / "data/sfm.png").write_bytes(b"no picture")
    (run / "poses.json").write_text(json.dumps({"views": [EVIL, {"turned_degrees": 1e300}, {"turned_degrees": None}]}))
    text = cameras_html(run)
    assert "sfm.json is not valid JSON" in text
    assert "by 0.000 degrees" in text
    assert EVIL not in text
