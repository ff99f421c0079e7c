"""Guidance at work in a run, with stand-ins for the prior: which gradients move, which pictures are kept, and when."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud

from gsopt.gaussians import PARAMETERS
from gsopt.raster.backend import Gradients
from gsopt.sds.guidance_memory import Counts, CoverageRecord
from gsopt.sds.guidance_step import COVERAGE_EVERY, MAX_FAILURES, Guidance, StepRecord
from gsopt.training.guided import session, start
from gsopt.training.guided.session import RunGuidance


def gradients(value: float, count: int = 4) -> Gradients:
    def full(*shape: int) -> torch.Tensor:
        return torch.full((count, *shape), value)

    return Gradients(full(3), full(4), full(3), full(), full(1, 3), full(3, 3), full(2), None)


class Fake:
    """Guidance whose every step is guided, and the pictures that it drew."""

    def __init__(self, planned: int = 9) -> None:
        self.plan = SimpleNamespace(guided_steps=planned)
        self.memory = SimpleNamespace(
            counts=Counts(), coverage=CoverageRecord(0, torch.ones(4), torch.tensor([0.2, 0.9]))
        )
        self.last: StepRecord | None = None
        self.prior = "prior"
        self.drawn: list[Any] = []
        white = SimpleNamespace(colors=torch.ones(6, 6, 3))
        candidates = type(
            "Candidates", (), {"__getitem__": lambda self, i: f"camera {i}", "forwards": torch.eye(3)[:2]}
        )
        self.observer = SimpleNamespace(
            cameras=SimpleNamespace(candidates=candidates()),
            backend=SimpleNamespace(forward=lambda splats, camera, *_: (self.drawn.append(camera), white)[1]),
            coverage=lambda step, splats: CoverageRecord(step, torch.zeros(4), torch.zeros(2)),
            uncertainty=lambda splats, covered, camera: (self.drawn.append(covered.tolist()), torch.ones(6, 6))[1],
        )

    def gradients(self, step: int, splats: Any, settings: Any) -> Gradients | None:
        if step % 2:
            return None
        self.memory.counts.guided += 1
        image = torch.full((3, 6, 6), 0.5)
        self.last = StepRecord(step, 1, f"text {step}", image, torch.ones(6, 6), image)
        return gradients(2.0)

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"t": torch.ones(1)}, {"m": 1}


def ran(folder: Path | None, steps: range, planned: int = 9) -> tuple[RunGuidance, Fake, Gradients]:
    fake, into = Fake(planned), gradients(1.0)
    run = RunGuidance(fake, folder, {"model": "m"})  # type: ignore[arg-type]
    for step in steps:
        run.add(step, cloud(4, 0), None, into)  # type: ignore[arg-type]
    return run, fake, into


def test_guidance_moves_every_parameter_and_not_what_density_control_sees(tmp_path: Path) -> None:
    _, _, into = ran(tmp_path, range(2, 3))
    for name in PARAMETERS:
        assert set(getattr(into, name).flatten().tolist()) == {3.0}, name
    assert set(into.means2d.flatten().tolist()) == {1.0}
    _, fake, untouched = ran(tmp_path, range(1, 2))
    assert set(untouched.means.flatten().tolist()) == {1.0}
    assert fake.drawn == []


def test_pictures_are_of_the_views_before_and_after_and_of_four_guided_steps(tmp_path: Path) -> None:
    """Of nine guided steps the first, and three more; the most uncertain view comes first."""
    run, fake, _ = ran(tmp_path, range(2, 20))
    names = {path.stem for path in tmp_path.iterdir()}
    before = {"before_00", "before_01", "before_00_uncertainty", "before_01_uncertainty"}
    kinds = ("render", "proposal", "uncertainty")
    assert names == before | {f"step_{step:06d}_{kind}" for step in (2, 6, 12, 18) for kind in kinds}
    assert fake.drawn == ["camera 1", [1.0] * 4, "camera 0", [1.0] * 4]
    fake.memory.coverage = None
    run.finish(cloud(4, 0), None)  # type: ignore[arg-type]
    assert {path.stem for path in tmp_path.glob("after*")} == {name.replace("before", "after") for name in before}
    assert fake.drawn[4:] == ["camera 1", [0.0] * 4, "camera 0", [0.0] * 4]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["samples"] == [{"step": step, "text": f"text {step}"} for step in (2, 6, 12, 18)]
    assert (summary["model"], summary["wanted"], summary["guided"], summary["views"]) == ("m", 9, 9, [1, 0])


def test_a_step_that_is_taken_again_is_shown_once_and_a_run_without_guided_steps_shows_none(tmp_path: Path) -> None:
    run, fake, _ = ran(tmp_path, range(2, 3))
    assert fake.last is not None
    run._save_sample(tmp_path, replace(fake.last, text="again"))
    assert run._samples == [{"step": 2, "text": "again"}]
    none, _, _ = ran(tmp_path / "none", range(1, 2))
    (tmp_path / "none").mkdir()
    none.finish(cloud(4, 0), None)  # type: ignore[arg-type]
    assert [path.name for path in (tmp_path / "none").iterdir()] == ["summary.json"]


def test_a_short_run_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[Any] = []
    monkeypatch.setattr(session, "save_stills", lambda *args, **_: saved.append(args))
    monkeypatch.setattr(session, "write_atomic", lambda *args: saved.append(args))
    run, fake, into = ran(None, range(2, 3))
    run.finish(cloud(4, 0), None)  # type: ignore[arg-type]
    assert saved == fake.drawn == []
    assert set(into.means.flatten().tolist()) == {3.0}


def test_a_checkpoint_carries_the_views_and_samples_of_the_report(tmp_path: Path) -> None:
    run, fake, _ = ran(tmp_path, range(2, 3))
    tensors, meta = run.state()
    assert set(tensors) == {"t"}
    assert meta == {"m": 1, "views": [1, 0], "samples": [{"step": 2, "text": "text 2"}]}
    again, told = RunGuidance(fake, tmp_path), list[Any]()  # type: ignore[arg-type]
    fake.restore = lambda *state: told.append(state)  # type: ignore[attr-defined]
    again.restore(tensors, meta)
    assert told == [(tensors, meta)]
    assert again.state() == (tensors, meta)
    assert again.state()[1]["views"] is not meta["views"]


def failing(count: int) -> tuple[Any, list[str]]:
    """Guidance whose prior fails so many times, then answers."""
    told: list[str] = []
    answers = iter([torch.OutOfMemoryError("full")] * count + [None])

    def guided(*_: Any) -> str:
        error = next(answers)
        if error is not None:
            raise error
        return "gradients"

    guidance: Any = object.__new__(Guidance)
    guidance.__dict__.update(
        weight=0.2,
        _warn=told.append,
        plan=SimpleNamespace(min_uncertainty=0.0, seed=0, is_guided=lambda step: True),
        memory=SimpleNamespace(counts=Counts(), coverage=None),
        observer=SimpleNamespace(coverage=lambda step, splats: CoverageRecord(step, torch.ones(4), torch.ones(3))),
        _guided=guided,
    )
    return guidance, told


def test_three_failures_in_a_row_end_guidance_and_a_success_forgives() -> None:
    for failures, ended in ((MAX_FAILURES - 1, False), (MAX_FAILURES, True)):
        guidance, told = failing(failures)
        found = [guidance.gradients(step, None, None) for step in range(failures + 1)]
        assert found == [None] * failures + [None if ended else "gradients"]
        counts = guidance.memory.counts
        assert (counts.failed, counts.ended, counts.guided) == (failures, ended, int(not ended))
        assert counts.failed_in_a_row == (failures if ended else 0)
        assert ["the run goes on without guidance" in line for line in told] == [False] * 2 + [True] * ended
        assert guidance.is_due(9) != ended


def test_coverage_is_taken_anew_after_a_hundred_steps_or_a_change() -> None:
    guidance, _ = failing(0)
    first = guidance._coverage(10, None)
    assert guidance._coverage(10 + COVERAGE_EVERY - 1, None) is first
    second = guidance._coverage(10 + COVERAGE_EVERY, None)
    assert (second.step, first.step) == (110, 10)
    guidance.forget()
    assert guidance._coverage(111, None).step == 111


@pytest.mark.parametrize(("weight", "planned", "due"), [(0.2, True, True), (0.0, True, False), (0.2, False, False)])
def test_a_step_is_guided_where_it_is_planned_and_weighed(weight: float, planned: bool, due: bool) -> None:
    guidance, _ = failing(0)
    guidance.weight, guidance.plan.is_guided = weight, lambda step: planned
    assert guidance.is_due(1) == due
    assert (guidance.gradients(1, None, None) is not None) == due


def test_a_step_that_the_input_views_decide_is_counted_and_asks_nothing() -> None:
    guidance, _ = failing(1)
    guidance.plan.min_uncertainty = 2.0
    assert guidance.gradients(1, None, None) is None
    assert (guidance.memory.counts.decided, guidance.memory.counts.failed) == (1, 0)


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1.0, "lambda_sds 0.5 (why)"),
        (0.25, "lambda_sds 0.125, lowered from 0.5 (why)"),
        (0.0, "lambda_sds 0, lowered from 0.5 (why)"),
    ],
)
def test_the_weight_that_the_guard_left_is_told(factor: float, told: str) -> None:
    verdict: Any = SimpleNamespace(factor=factor, reason="why", trials=[])
    assert start._sentence(verdict, 0.5) == told
    assert start._record(verdict, "p", "sds") == {
        "model": "p", "policy": "sds", "guard": {"factor": factor, "reason": "why", "trials": []},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("least", "mean_u", "decide"),
    [(0.0, [0.0, 0.0], False), (0.5, [0.4, 0.49], True), (0.5, [0.4, 0.5], False), (0.5, [0.6, 0.7], False)],
)
def test_the_input_views_decide_where_all_views_are_certain(
    least: float, mean_u: list[float], decide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start, "first_gaussians", lambda *_: (None, ""))
    observed = SimpleNamespace(coverage=lambda step, splats: SimpleNamespace(mean_u=torch.tensor(mean_u)))
    guidance: Any = SimpleNamespace(plan=SimpleNamespace(min_uncertainty=least), observer=observed)
    plan: Any = SimpleNamespace(init=None, schedule=SimpleNamespace(max_sh_degree=1), seed=0)
    assert start.inputs_decide(plan, None, guidance) == decide  # type: ignore[arg-type]
