"""Steps of the one call from photos to a report: settings and paths, poses and masks, and the end of a run."""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tiny_scenes import tiny_config

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.errors import UsageError
from gsopt.events import read_events, to_json
from gsopt.training.interrupt import Stopped

steps = importlib.import_module("gsopt.training.reconstruct")


def recorded(run: Path, config: TrainConfig) -> Path:
    run.mkdir(exist_ok=True)
    (run / "config.json").write_bytes(to_json({"config": config.to_dict()}))
    return run


def test_only_a_run_in_cells_with_the_same_settings_goes_on_by_itself(tmp_path: Path) -> None:
    config = replace(TrainConfig(data=DataConfig(path="/a")), cells="2")
    assert not steps.goes_on(config, tmp_path / "none")
    run = recorded(tmp_path / "run", config)
    assert steps.goes_on(config, run)
    assert steps.goes_on(replace(config, threads=7), run)
    assert not steps.goes_on(replace(config, seed=7), run)
    plain = replace(config, cells="")
    assert not steps.goes_on(plain, recorded(tmp_path / "plain", plain))


def test_settings_come_from_one_place(tmp_path: Path) -> None:
    """Fields, a whole config, or what a run began with; the data may stand beside either."""
    config = TrainConfig(data=DataConfig(path="/a", views=3), seed=5)
    run = recorded(tmp_path / "run", config)
    assert steps._configured(None, run, None, True, {}) == config
    assert steps._configured(None, run, config, False, {}) == config
    assert steps._configured("/b", run, config, False, {}) == replace(config, data=DataConfig(path="/b", views=3))
    assert steps._configured(DataConfig(path="/c"), run, config, False, {}).data == DataConfig(path="/c")
    assert steps._configured("/b", run, None, False, {"seed": 6}).seed == 6
    with pytest.raises(UsageError, match="`config` and `seed` were both given"):
        steps._configured("/b", run, config, False, {"seed": 6})
    for resume, settings in ((False, {}), (True, {"seed": 6})):
        with pytest.raises(UsageError, match="A dataset is needed"):
            steps._configured(None, run, None, resume, settings)


def test_paths_become_absolute_and_words_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("masks", "depths", "net.onnx", "ref.png"):
        (tmp_path / name).mkdir()
    data = DataConfig(path="scene", masks="masks", depth="depths", mask_model="net.onnx")
    config = TrainConfig(data=data, guidance=GuidanceConfig(prior="sd21", ref_image=("ref.png",)))
    found = steps._with_absolute_paths(config)
    here = {name: str(tmp_path / name) for name in ("scene", "masks", "depths", "net.onnx", "ref.png")}
    assert (found.data.path, found.data.masks, found.data.depth) == (here["scene"], here["masks"], here["depths"])
    assert (found.data.mask_model, found.guidance.ref_image) == (here["net.onnx"], (here["ref.png"],))
    assert found.guidance.prior == "sd21"
    for word in ("given", "auto", "none"):
        (tmp_path / word).mkdir()
        assert steps._absolute_masks(word) == word
    bare = steps._with_absolute_paths(TrainConfig(data=DataConfig(path="scene"))).data
    assert (bare.depth, bare.mask_model) == (DataConfig().depth, DataConfig().mask_model)


@pytest.mark.parametrize(
    ("masks", "asked", "left"),
    [("given", "auto", "given"), ("auto", "auto", "auto"), ("none", "none", "none"), ("/m", "/m", "given")],
)
def test_photos_without_poses_become_a_scene_beside_the_run(
    masks: str, asked: str, left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[Any] = []

    def posed(data: Path, folder: Path, sfm: Any, log: Any) -> Path:
        calls.append((data, folder, sfm.masks, sfm.seed, sfm.threads, sfm.features))
        return tmp_path / "posed"

    monkeypatch.setattr(steps, "needs_poses", lambda data: True)
    monkeypatch.setattr(steps, "posed_scene", posed)
    config = TrainConfig(data=DataConfig(path="/photos", masks=masks, features="sift"), seed=3, threads=2)
    found = steps._with_poses(config, tmp_path / "run", print)
    assert calls == [(Path("/photos"), tmp_path, asked, 3, 2, "sift")]
    assert (found.data.path, found.data.masks) == (str(tmp_path / "posed"), left)


@pytest.mark.parametrize(("features", "told"), [("xfeat", 1), ("both", 1), ("sift", 0), ("auto", 0)])
def test_a_dataset_with_poses_is_left_as_it_is(
    features: Any, told: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    monkeypatch.setattr(steps, "needs_poses", lambda data: False)
    config = TrainConfig(data=DataConfig(path="/scene", features=features))
    assert steps._with_poses(config, tmp_path / "run", lines.append) is config
    assert len(lines) == told


def test_masks_are_made_where_they_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = DataConfig(path="/scene", masks="/made")
    monkeypatch.setattr(steps, "with_made_masks", lambda data, folder, log: (made, folder)[folder != tmp_path])
    config = TrainConfig(data=DataConfig(path="/scene", masks="auto"))
    assert steps._with_masks(config, tmp_path / "run", print).data is made
    given = TrainConfig(data=DataConfig(path="/scene"))
    assert steps._with_masks(given, tmp_path / "run", print) is given


@pytest.mark.parametrize("config", [GuidanceConfig(), GuidanceConfig(prior="sd21")])
def test_a_prior_that_somebody_asks_for_is_required_before_any_work(
    config: GuidanceConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsopt.training import library_body, shape_prior_body
    from gsopt.training.guided import start

    asked: list[str] = []
    monkeypatch.setattr(start, "require_guidance", lambda config: asked.append("guidance"))
    monkeypatch.setattr(library_body, "require_library", lambda config: asked.append("library"))
    monkeypatch.setattr(shape_prior_body, "require_shape_prior", lambda config: asked.append("shape"))
    steps._require_prior(config)
    assert asked == ([] if config == GuidanceConfig() else ["guidance", "library", "shape"])


@pytest.mark.parametrize(
    ("helps", "change", "told"),
    [
        (True, 0.01234, "cleaned: 3 of 10 splats go; views without a part in the decision change by +0.0123 dB"),
        (False, -0.5, "not cleaned: views without a part in the decision change by -0.5000 dB"),
        (False, math.nan, "not cleaned: one input view leaves none to judge by"),
    ],
)
def test_splats_go_where_views_without_a_part_in_it_do_not_lose(
    helps: bool, change: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsopt.results import clean_files

    cleaning = SimpleNamespace(left_out=3, gaussians=[1] * 7) if helps else None
    monkeypatch.setattr(clean_files, "clean_where_it_helps", lambda run: (cleaning, change))
    monkeypatch.setattr(steps, "replace", lambda result, gaussians: gaussians)
    lines: list[str] = []
    result = SimpleNamespace(run=Path("run"), gaussians=[1] * 10)
    found = steps._cleaned(result, lines.append)
    assert found == ([1] * 7 if helps else result)
    assert lines == [told]


class Clock:
    def __init__(self) -> None:
        self.now = 50.0

    def perf_counter(self) -> float:
        return self.now


def test_evaluated_views_are_told_twice_a_second_and_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, told = Clock(), list[int]()
    monkeypatch.setattr(steps, "time", clock)
    directory: Any = SimpleNamespace(emit=lambda kind, views, total: told.append(views))
    checked: list[None] = []
    follow = steps._follower(directory, SimpleNamespace(check=lambda: checked.append(None)))
    for views, later in ((1, 0.25), (2, 0.5), (3, 0.75), (4, 1.0), (5, 1.0)):
        clock.now = 50.0 + later
        follow(views, 5)
    assert told == [2, 4, 5]
    assert len(checked) == 5


def finished(run: Path, peak: float | None = 123.456) -> Any:
    return SimpleNamespace(
        run=run, gaussians=[1] * 7, scene=None, steps=30, init="points", train_seconds=12.34567,
        cpu_seconds=23.45678, peak_memory_mb=peak,
    )  # fmt: skip


@pytest.mark.parametrize("ending", ["done", "stopped", "error"])
def test_the_last_event_tells_how_a_run_ended(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The facts of training stand in metrics.json even then."""
    from gsopt.results import report

    def evaluate(run: Path, **_: object) -> dict[str, int]:
        assert json.loads((run / "metrics.json").read_text())["earlier"] == 1
        if ending == "stopped":
            raise Stopped
        if ending == "error":
            raise ZeroDivisionError
        return {"psnr": 30}

    config = tiny_config(tmp_path / "scene")
    run = recorded(tmp_path / "run", config)
    (run / "metrics.json").write_text('{"earlier": 1}')
    monkeypatch.setattr(steps, "evaluate", evaluate)
    monkeypatch.setattr(report, "write_report", lambda run: run / "report.html")
    stop = SimpleNamespace(check=lambda: None)
    if ending == "error":
        with pytest.raises(ZeroDivisionError):
            steps._evaluated(config, finished(run), False, None, stop)
    else:
        found = steps._evaluated(config, finished(run, None if ending == "stopped" else 123.456), False, None, stop)
        assert found == (({"psnr": 30}, run / "report.html") if ending == "done" else (None, None))
    last = read_events(run / "events.jsonl")[0][-1]
    assert last["kind"] == ending
    if ending != "error":
        assert (last["step"], last["n"], last["seconds"]) == (30, 7, 12.346)
    facts = json.loads((run / "metrics.json").read_text())
    assert (facts["train_seconds"], facts["train_cpu_seconds"]) == (12.346, 23.457)
    assert (facts["n_gaussians"], facts["steps"], facts["init"]) == (7, 30, "points")
    assert facts["peak_memory_mb"] == (None if ending == "stopped" else 123.5)


@pytest.mark.parametrize(
    ("resume", "cells", "stopped", "clean", "done"),
    [
        (False, "", False, False, ["refuse", "prior", "masks", "networks", "metrics", "train", "evaluated"]),
        (False, "", False, True, ["refuse", "prior", "masks", "networks", "metrics", "train", "cleaned", "evaluated"]),
        (True, "", True, True, ["networks", "metrics", "train"]),
        (False, "2", True, False, ["refuse", "prior", "masks", "networks", "metrics", "cells"]),
    ],
)
def test_what_can_be_refused_is_refused_before_any_work_and_a_stopped_run_is_not_judged(
    resume: bool, cells: str, stopped: bool, clean: bool, done: list[str], tmp_path: Path, monkeypatch: Any
) -> None:
    from gsopt.training.cells import run as cells_run

    order: list[str] = []
    result = finished(tmp_path / "run")
    result.stopped = stopped

    def noting(name: str, answer: Any = None) -> Any:
        return lambda *_, **__: (order.append(name), answer)[1]

    for name, label in (
        ("refuse_another_run", "refuse"), ("_require_prior", "prior"), ("require_mask_model", "masks"),
        ("networks", "networks"), ("read_metrics", "metrics"),
    ):  # fmt: skip
        monkeypatch.setattr(steps, name, noting(label))
    monkeypatch.setattr(steps, "_with_poses", lambda config, run, log: config)
    monkeypatch.setattr(steps, "_with_masks", lambda config, run, log: config)
    monkeypatch.setattr(steps, "train", noting("train", result))
    monkeypatch.setattr(cells_run, "train_in_cells", noting("cells", result))
    monkeypatch.setattr(steps, "_cleaned", noting("cleaned", result))
    monkeypatch.setattr(steps, "_evaluated", noting("evaluated", ({"psnr": 30}, tmp_path / "report.html")))
    (tmp_path / "run").mkdir()
    found = steps.reconstruct("/scene", tmp_path / "run", config=TrainConfig(cells=cells, clean=clean), resume=resume)
    assert order == done
    assert (found.metrics, found.report) == ((None, None) if stopped else ({"psnr": 30}, tmp_path / "report.html"))
