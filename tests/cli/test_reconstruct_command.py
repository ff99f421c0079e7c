"""`gsopt reconstruct`: one command to a report, and again to go on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_scenes import write_dataset

from gsopt.cli import main
from gsopt.cli.reconstruct import Flags, train_arguments


def test_it_writes_a_report_and_goes_on_when_called_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = write_dataset(tmp_path / "data", train=3, test=1)
    run = tmp_path / "run"
    monkeypatch.setattr("gsopt.cli.reconstruct.train_arguments", lambda flags: shortened(flags))
    assert main(["reconstruct", str(data), "-m", str(run)]) == 0
    assert (run / "report.html").is_file()
    splats = (run / "splat.ply").read_bytes()
    assert json.loads((run / "config.json").read_text())["config"]["data"]["masks"] == "given"
    (run / "report.html").unlink()
    assert main(["reconstruct", str(data), "-m", str(run)]) == 0
    assert (run / "report.html").is_file()
    assert (run / "splat.ply").read_bytes() == splats
    assert "report:" in capsys.readouterr().out


def shortened(flags: Flags) -> list[str]:
    return [*train_arguments(flags), "--iterations", "4", "--init-count", "200", "--lambda-sds", "0"]


def test_flags_reach_the_training(tmp_path: Path) -> None:
    flags = Flags(tmp_path / "photos", masks="none", features="both", preset="draft", eval=True, threads=2)
    words = train_arguments(replace(flags, mask_model=Path("a.onnx")))
    assert words[:3] == [str(tmp_path / "photos"), "-m", str(Path("runs") / "photos")]
    assert "--resume" not in words
    for pair in (
        ["--masks", "none"],
        ["--features", "both"],
        ["--mask-model", "a.onnx"],
        ["--preset", "draft"],
        ["--threads", "2"],
    ):
        assert words[words.index(pair[0]) + 1] == pair[1]
    assert "--eval" in words
