"""The report's part on guidance: it says what summary.json says, shows the pictures, and survives what is broken."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from gsopt.results.report.guidance_section import guidance_section

SUMMARY = {
    "model": "toy <b>prior</b>",
    "policy": "recon",
    "lambda_sds": 0.2,
    "guard": {"factor": 1.0, "reason": "+0.31 dB on r_2 when left out"},
    "wanted": 40,
    "guided": 31,
    "decided": 8,
    "failed": 1,
    "ended": False,
    "views": [3, 17],
    "samples": [{"step": 12, "text": "a chair, back view"}],
}


def write(run: Path, summary: object) -> Path:
    folder = run / "guidance"
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text(summary if isinstance(summary, str) else json.dumps(summary))
    for view in (3, 17):
        for when in ("before", "after"):
            Image.new("RGB", (8, 8), "red").save(folder / f"{when}_{view:02d}.png")
            Image.new("RGB", (8, 8), "gray").save(folder / f"{when}_{view:02d}_uncertainty.png")
    for kind in ("render", "proposal", "uncertainty"):
        Image.new("RGB", (8, 8), "blue").save(folder / f"step_000012_{kind}.png")
    return run


def test_it_says_and_shows_what_guidance_did(tmp_path: Path) -> None:
    messages: list[str] = []
    html = guidance_section(write(tmp_path, SUMMARY), messages)
    assert messages == []
    assert "31 of 40 steps" in html
    assert "8 were skipped" in html
    assert "+0.31 dB on r_2" in html
    assert "toy &lt;b&gt;prior" in html
    assert "a chair, back view" in html
    assert html.count("<img") == 2 * 4 + 3


def test_it_says_the_weight_that_the_guard_left(tmp_path: Path) -> None:
    halved = {**SUMMARY, "guard": {"factor": 0.5, "reason": "tried twice"}}
    assert "lambda 0.1 (tried twice)" in guidance_section(write(tmp_path, halved), [])


def test_a_run_without_guidance_has_no_such_part(tmp_path: Path) -> None:
    assert guidance_section(tmp_path, []) == ""


@pytest.mark.parametrize("summary", ["{", "[]", '{"views": "x"}', '{"views": [1e99, "../../etc", -1], "samples": [7]}'])
def test_what_is_broken_is_left_out(summary: str, tmp_path: Path) -> None:
    messages: list[str] = []
    html = guidance_section(write(tmp_path, summary), messages)
    assert "<img" not in html
    assert bool(messages) == (summary in ("{", "[]"))


def test_a_picture_that_is_none_is_left_out(tmp_path: Path) -> None:
    run = write(tmp_path, SUMMARY)
    (run / "guidance" / "before_03.png").write_bytes(b"no picture")
    (run / "guidance" / "step_000012_proposal.png").unlink()
    assert guidance_section(run, []).count("<img") == 2 * 4 + 3 - 2
