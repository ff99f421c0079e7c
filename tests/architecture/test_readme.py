"""README.md: its Python runs, its verbs are all verbs, its figures stand in the result files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from statistics import mean

import pytest

import gsopt
from gsopt.cli import VERBS
from gsopt.training.open_settings import FEW_OF_AN_OBJECT

DEMO = Path(gsopt.__file__).parent / "demo"
MAX_LINES = 120


@pytest.fixture(scope="module")
def readme(root: Path) -> str:
    return (root / "README.md").read_text(encoding="utf-8")


def python_block(page: str) -> str:
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    return block


def verbs(page: str) -> list[str]:
    """The verbs in the first column of the table."""
    return re.findall(r"^\| `gsopt ([\w-]+)", page, re.MULTILINE)


def scene_rows(page: str) -> list[tuple[str, str]]:
    """PSNR and Gaussians of the table of scenes."""
    return re.findall(r"^\| [^|]*steps \| ([\d.]+) dB \| ([\d,]+) \|", page, re.MULTILINE)


def recorded_rows(scenes: dict) -> set[tuple[str, str]]:
    figures = [(case["mean"]["psnr"], case["n_gaussians"]) for case in scenes.values()]
    return {(f"{psnr:.2f}", f"{count:,}") for psnr, count in figures}


def suite_mean(runs: list[dict], group: str, arm: str, steps: int) -> float:
    """Mean PSNR over scenes, seeds averaged first."""
    found: dict[str, list[float]] = {}
    for run in runs:
        if (run["group"], run["arm"], run["iterations"]) == (group, arm, steps):
            found.setdefault(run["scene"], []).append(run["mean"]["psnr"])
    assert len(found) == 16
    return mean(mean(values) for values in found.values())


def test_the_page_is_short(readme: str) -> None:
    assert len(readme.splitlines()) <= MAX_LINES


def test_its_python_runs(readme: str, tmp_path: Path, monkeypatch, capsys) -> None:
    code = python_block(readme)
    assert "iterations=2000" in code
    assert '"DATA"' in code
    monkeypatch.chdir(tmp_path)
    exec(code.replace("iterations=2000", "iterations=5").replace('"DATA"', repr(str(DEMO))), {})
    assert "Gaussians, image (1, 128, 128, 3)" in capsys.readouterr().out
    assert (tmp_path / "runs/chair/report.html").is_file()
    assert (tmp_path / "chair.splat").is_file()


def test_its_verbs_are_all_verbs(readme: str) -> None:
    assert sorted(verbs(readme)) == sorted(VERBS)
    assert sorted(verbs(readme.replace("| `gsopt eval", "| `"))) != sorted(VERBS)


def test_its_scenes_are_those_of_the_result_file(root: Path, readme: str) -> None:
    recorded = recorded_rows(json.loads((root / "experiments/results/scenes.json").read_text(encoding="utf-8")))
    rows = scene_rows(readme)
    assert len(rows) == 4
    assert set(rows) <= recorded
    assert not {("32.98", rows[0][1])} <= recorded


def test_its_first_paragraph_is_what_the_suite_measured(root: Path, readme: str) -> None:
    runs = json.loads((root / "experiments/results/suite-sparse.json").read_text(encoding="utf-8"))["runs"]
    text = " ".join(readme.split())
    for views, sentence in ((4, "views are {} dB better"), (6, "6 photos the gain is {} dB"), (8, "with 8 it is {}.")):
        before = suite_mean(runs, f"objects-{views}", "3dgs", 500 * views)
        after = suite_mean(runs, f"objects-{views}", "ours-0", FEW_OF_AN_OBJECT.steps_per_view * views)
        assert sentence.format(f"{after - before:.2f}") in text
        assert views > 4 or f"{after:.2f} against {before:.2f} dB" in text
    guided, unguided = (suite_mean(runs, "objects-4", arm, 2000) for arm in ("ours", "ours-0"))
    assert f"adds {guided - unguided:.2f} dB" in text
