"""experiments/prompts.py in small: every arm once, nothing twice, a table of what was measured."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from gsopt import cli
from gsopt.cli.train import read_flags
from gsopt.cli.train_flags import parse
from gsopt.config.guidance import GuidanceConfig
from gsopt.sds.prompts import read_prompts

SCRIPT = Path(__file__).resolve().parents[2] / "experiments" / "prompts.py"


@pytest.fixture
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_of_prompts", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_arm_is_run_once_with_its_own_prompts_and_the_table_pairs_them(
    benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """`gsopt prompts` is real; of `gsopt train` the flags are read and the figures made up."""
    scene = tmp_path / "scenes" / "chair"
    scene.mkdir(parents=True)
    (scene / "transforms_test.json").touch()
    (tmp_path / "notes.json").write_text('{"chair": {"notes": "red chair", "domain": "robotics"}}')
    asked: dict[str, GuidanceConfig] = {}

    def gsopt(arguments: list[str]) -> int:
        if arguments[0] == "prompts":
            return cli.main(arguments)
        config, run = read_flags(parse(arguments[1:]))
        asked[run.name.rpartition("-")[2]] = config.guidance
        run.mkdir(parents=True)
        mean = {"psnr": 20.0 + len(config.guidance.prompts) % 2 + config.seed, "ssim": 0.5, "lpips_alex": None}
        (run / "metrics.json").write_text(json.dumps({"mean": mean}))
        return 0

    monkeypatch.setattr(benchmark, "gsopt", gsopt)
    monkeypatch.setattr(benchmark, "takes_words", lambda prior: False)
    monkeypatch.chdir(tmp_path)
    few = ["--seeds", "2", "--views", "3", "--flag=--resolution=2", "--runs", "runs", "--notes", "notes.json"]
    monkeypatch.setattr(sys, "argv", ["prompts", "scenes", "--prior", "a/b", "-o", "out.json", *few])
    benchmark.main()
    document = json.loads((tmp_path / "out.json").read_text())
    assert [record["arm"] for record in document["runs"]] == ["off", "none", "user", "template"] * 2
    assert asked["off"].lambda_sds == 0
    assert asked["none"].lambda_sds == 0.2
    assert asked["none"].prompts == ""
    words = {arm: [p.source for p in read_prompts(Path(asked[arm].prompts))] for arm in ("user", "template")}
    assert words["user"] == ["user"]
    assert set(words["template"]) == {"template"}
    out = capsys.readouterr().out
    assert "takes no words" in out
    assert "| none | 2 | 20.50 (0.50) | +0.00 |" in out
    monkeypatch.setattr(benchmark, "run", None)  # a second call finds everything measured
    benchmark.main()
    assert json.loads((tmp_path / "out.json").read_text())["runs"] == document["runs"]


def test_every_validation_object_has_notes_that_make_prompts(benchmark, tmp_path: Path, shared_data: Path) -> None:
    from gsopt.llm_prompts.generate import PromptJob, make_prompts

    notes = json.loads((SCRIPT.parent / "prompts_notes.json").read_text())
    objects = [name.split("/")[-1] for name in json.loads((shared_data / "splits.json").read_text())["val"]]
    assert sorted(notes) == sorted(objects)
    for note in notes.values():
        made = make_prompts(PromptJob(**note), print).made
        assert len(made.prompts) == 12
        assert made.object in note["notes"]
