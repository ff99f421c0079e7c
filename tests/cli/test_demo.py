"""`gsopt demo` hands the shipped scene to `gsopt train` and keeps earlier demos."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

from gsopt import cli
from gsopt.cli import demo


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[list[str]]:
    """Stands in for `gsopt train`: records its arguments and writes a report. Runs in an empty folder."""
    calls: list[list[str]] = []

    def train(argv: list[str]) -> int:
        calls.append(argv)
        run = Path(argv[argv.index("-m") + 1])
        run.mkdir(parents=True)
        (run / "report.html").write_text("<html>")
        return 0

    module = ModuleType("gsopt.cli.train")
    module.main = train  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsopt.cli.train", module)
    monkeypatch.setattr(cli, "train", module, raising=False)  # where the real one was imported before
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "transforms_train.json").write_text("{}")
    monkeypatch.setattr(demo, "SCENE", scene)
    monkeypatch.chdir(tmp_path)
    return calls


def test_the_demo_ends_with_the_report_to_open(trained, tmp_path: Path, capsys) -> None:
    assert cli.main(["demo", "-m", "here", "--iterations", "7"]) == 0
    assert trained == [[str(tmp_path / "scene"), "-m", "here", "--iterations", "7"]]
    assert str(tmp_path / "here/report.html") in capsys.readouterr().out


def test_a_second_demo_does_not_touch_the_first(trained) -> None:
    assert [cli.main(["demo"]) for _ in range(3)] == [0, 0, 0]
    assert [call[call.index("-m") + 1] for call in trained] == ["runs/demo", "runs/demo-2", "runs/demo-3"]


def test_a_missing_scene_is_an_input_error(trained, monkeypatch, capsys) -> None:
    monkeypatch.setattr(demo, "SCENE", Path("nowhere"))
    assert cli.main(["demo"]) == 3
    assert "nowhere" in capsys.readouterr().err
    assert trained == []


def test_the_scene_that_ships_can_be_loaded() -> None:
    from gsopt.data.scene import load_scene

    scene = load_scene(demo.SCENE)
    assert len(scene.train) > 0
    assert len(scene.test) > 0
