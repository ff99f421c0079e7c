"""A report is written whatever stands in a run's files: names that are no text, huge numbers, deep nesting."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from finished_runs import make_run

from gsopt.errors import InputError
from gsopt.events import EventWriter, to_json
from gsopt.results.evaluation import evaluate
from gsopt.results.report import write_report

LONE = "caf\udce9 \ud800"
HUGE = 10**400
DEPTHS = range(900, 1000, 10)
"""Around the depth that json can just read below this call."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("untrusted"), train=1, test=1)


@pytest.fixture(scope="module")
def config(run: Path) -> dict[str, Any]:
    return json.loads((run / "config.json").read_text())


@pytest.fixture
def write(run: Path, config: dict[str, Any]) -> Callable[..., str]:
    """Replaces files of the run for one report, and returns its page."""
    data = run.parent / "data"

    def write(metrics: object = None, summary: object = None, sfm: object = None, **recorded: object) -> str:
        (run / "guidance").mkdir(exist_ok=True)
        for path, document in (
            (run / "metrics.json", metrics or {}),
            (run / "guidance/summary.json", summary or {}),
            (data / "sfm.json", sfm or {}),
            (run / "config.json", {**config, **recorded}),
        ):
            path.write_text(document if isinstance(document, str) else json.dumps(document))
        return write_report(run).read_text(encoding="utf-8")

    return write


def test_a_dataset_whose_name_is_no_text_has_a_report(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=1)
    folder = os.fsencode(tmp_path) + b"/caf\xe9"
    os.rename(tmp_path / "data", folder)
    document = json.loads((run / "config.json").read_text())
    document["config"]["data"]["path"] = os.fsdecode(folder)
    (run / "config.json").write_bytes(to_json(document))
    evaluate(run)
    text = write_report(run).read_text(encoding="utf-8")
    assert "caf\\udce9" in text
    assert "Means over held-out views" in text


def test_lone_surrogates_in_any_file_are_written_as_escapes(run: Path, write: Callable[..., str]) -> None:
    writer = EventWriter(run)
    writer.emit("warning", message=f"event {LONE}")
    writer.close()
    metrics = {"notes": [f"note {LONE}"], "reason": f"reason {LONE}", "protocol": f"protocol {LONE}"}
    summary = {"model": f"model {LONE}", "policy": LONE, "guard": {"reason": f"guard {LONE}"}}
    sfm = {"report": [f"sfm {LONE}"]}
    page = write(metrics, summary, sfm, versions={f"name {LONE}": f"version {LONE}"}, gaussians_init=f"init {LONE}")
    for what in ("event", "note", "reason", "protocol", "model", "guard", "sfm", "name", "version", "init"):
        assert f"{what} caf\\udce9 \\ud800" in page


def test_numbers_beyond_any_float_vanish_or_are_shortened(write: Callable[..., str]) -> None:
    names = ("psnr", "ssim", "n_gaussians", "steps", "train_seconds", "peak_memory_mb")
    metrics = {"mean": dict.fromkeys(names, HUGE), "per_view": [{"name": HUGE, "psnr": HUGE}], "notes": [HUGE]}
    keys = ("lambda_sds", "guided", "wanted", "decided", "failed", "views", "samples", "model", "policy")
    summary = {**dict.fromkeys(keys, HUGE), "guard": {"factor": HUGE, "reason": HUGE}, "samples": [{"step": HUGE}]}
    for weight, factor in ((HUGE, 1.0), (0.2, HUGE), (HUGE, HUGE), (1e299, 1e299)):
        summary |= {"lambda_sds": weight, "guard": {"factor": factor}}
        page = write({**metrics, **dict.fromkeys(names, HUGE)}, summary)
        assert "<h2>Guidance</h2>" in page
        assert "0" * 100 not in page


@pytest.mark.parametrize("depth", DEPTHS)
def test_deep_nesting_is_shortened(write: Callable[..., str], depth: int) -> None:
    def nested(document: dict[str, object]) -> str:
        return json.dumps(document).replace('"DEEP"', "[" * depth + "]" * depth)

    summary = {"model": "DEEP", "policy": "DEEP", "lambda_sds": "DEEP", "guard": {"reason": "DEEP"}}
    summary["samples"] = [{"step": 1, "text": "DEEP"}]
    page = write(
        nested({"notes": ["DEEP"], "per_view": [{"name": "DEEP"}]}), nested(summary), nested({"report": "DEEP"})
    )
    assert "[" * 50 not in page


@pytest.mark.parametrize("depth", DEPTHS)
def test_a_config_nested_deeply_is_reported_or_an_input_error(
    run: Path, config: dict[str, Any], write: Callable[..., str], depth: int
) -> None:
    write()
    recorded = config | {"gaussians_init": "DEEP", "symmetry": [{"about": "DEEP"}], "versions": {"a": "DEEP"}}
    (run / "config.json").write_text(json.dumps(recorded).replace('"DEEP"', "[" * depth + "]" * depth))
    with contextlib.suppress(InputError):
        assert "[" * 50 not in write_report(run).read_text(encoding="utf-8")
