"""Steps of a run in cells, with stand-ins for its runs: what is recorded, done again, merged, stopped and refused."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud, tiny_config

from gsopt.config.cells import CellConfig
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import ExposureConfig, PoseConfig, SparseConfig, TrainConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.farm.job import Outcome
from gsopt.formats.ply import save_ply
from gsopt.training.cells import run as driver
from gsopt.training.cells import stages
from gsopt.training.cells.plan import Cell, CellPlan
from gsopt.training.cells.stages import Stage, Stages
from gsopt.training.interrupt import Stopped, StopRequest
from gsopt.training.run_directory import RunDirectory, opened

FACTS = {"steps": 12, "n": 3456, "seconds": 7.4, "cpu_seconds": 9.0, "peak_memory_mb": None, "backend": "cpu"}


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[RunDirectory]:
    with opened(tmp_path / "run", tiny_config(Path("unused")), False, None) as found:
        yield found


class Farm:
    """Answers each job as it is told, or with figures."""

    def __init__(self, **answers: Any) -> None:
        self.answers, self.jobs = answers, list[Any]()

    def run(self, jobs: Any, report: Any = None) -> Iterator[Outcome]:
        for job in jobs:
            self.jobs.append(job)
            answer = self.answers.get(job.name.replace("/", "_"), FACTS)
            if isinstance(answer, str):
                yield Outcome(job, "failed", error=answer)
            else:
                folder = Path(job.request["run"])
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "splat.ply").touch()
                yield Outcome(job, "done", answer, host="there")


def made(directory: RunDirectory, farm: Farm, stop: Any = None) -> Stages:
    return Stages(directory, farm, stop or StopRequest(directory.stop_file), 3)


def stage(name: str, **changes: Any) -> Stage:
    return Stage(name, tiny_config(Path("/data"), **changes))


def test_a_stage_that_is_done_is_not_done_again_unless_its_splats_are_gone(directory: RunDirectory) -> None:
    farm = Farm()
    made(directory, farm).run([stage("coarse"), stage("cells/00")])
    assert [job.name for job in farm.jobs] == ["coarse", "cells/00"]
    recorded = directory.recorded("stages")
    assert recorded == {name: {**FACTS, "host": "there"} for name in ("cells/00", "coarse")}
    assert list(recorded) == ["cells/00", "coarse"]
    (directory.path / "coarse" / "splat.ply").unlink()
    again = Farm()
    made(directory, again).run([stage("coarse"), stage("cells/00"), stage("polish")])
    assert [job.name for job in again.jobs] == ["coarse", "polish"]


def test_a_job_has_the_threads_and_memory_of_the_run_and_may_write_only_there(directory: RunDirectory) -> None:
    farm = Farm()
    made(directory, farm).run([stage("coarse", max_memory="2 GB", threads=1), stage("polish")])
    limited, free = farm.jobs
    assert (limited.memory, free.memory) == (2_000_000_000, None)
    assert (limited.cpus, limited.request["config"]["threads"]) == (3, 3)
    assert limited.request["run"] == str(directory.path.absolute() / "coarse")
    assert limited.request["stop"] == str(directory.stop_file.absolute())
    assert (limited.inputs, limited.writes) == ((Path("/data"),), (directory.path.absolute(),))
    assert limited.fresh
    assert limited.seconds == 30 * 24 * 3600


def test_the_first_failure_is_told_when_all_others_are_done(directory: RunDirectory) -> None:
    farm = Farm(cells_02="no room", cells_01="no net")
    with pytest.raises(InputError, match=r"cells/01 failed: no net The same command goes on with the rest"):
        made(directory, farm).run([stage(f"cells/0{i}") for i in range(4)])
    assert set(directory.recorded("stages")) == {"cells/00", "cells/03"}


def test_a_stage_that_was_stopped_is_not_done(directory: RunDirectory) -> None:
    farm = Farm(coarse={**FACTS, "stopped": True})
    made(directory, farm).run([stage("coarse")])
    assert directory.recorded("stages") is None


@pytest.mark.parametrize("asked", ["before", "meanwhile"])
def test_a_request_to_stop_ends_the_stages(directory: RunDirectory, asked: str) -> None:
    """Even one that came while they were done; then they are recorded."""
    farm = Farm()
    stages_ = made(directory, farm)
    if asked == "before":
        directory.stop_file.touch()
    else:
        farm.answers["coarse"] = type("Late", (dict,), {})(FACTS)
        original = directory.record
        directory.record = lambda **fields: (original(**fields), directory.stop_file.touch())[0]  # type: ignore[method-assign,func-returns-value]
    with pytest.raises(Stopped):
        stages_.run([stage("coarse")])
    assert len(farm.jobs) == int(asked == "meanwhile")
    assert (directory.recorded("stages") is not None) == (asked == "meanwhile")


def test_a_request_to_stop_reaches_every_run_that_is_under_way(
    directory: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "POLL_SECONDS", 0.001)
    (directory.path / "coarse").mkdir()
    with made(directory, Farm())._passing_on_stops(["coarse", "cells/00"]):
        directory.stop_file.touch()
        for _ in range(9000):
            if (directory.path / "coarse" / "stop").exists():
                break
            time.sleep(0.001)
    assert (directory.path / "coarse" / "stop").exists()
    assert not (directory.path / "cells").exists()


def test_the_figures_of_all_stages_add_up(directory: RunDirectory) -> None:
    """Those of an earlier call too; a figure that nobody knows counts nowhere."""
    records = {"coarse": {**FACTS, "peak_memory_mb": 50.0}, "polish": {**FACTS, "seconds": 2.6, "peak_memory_mb": 70.0}}
    directory.record(stages={**records, "cells/00": {**FACTS, "seconds": None}})
    found = made(directory, Farm())
    assert (found.total("steps"), found.total("seconds")) == (36, 10.0)
    assert found.most("peak_memory_mb") == 70.0
    assert found.most("absent") is None
    directory.record(stages={"coarse": 3})
    with pytest.raises(InputError, match=r"`stages` in .* is garbled"):
        made(directory, Farm())


def test_the_line_of_a_stage_names_its_memory_where_it_is_known() -> None:
    assert stages._line("coarse", FACTS) == "coarse is done: 3,456 Gaussians, 12 steps, 7 s"
    told = stages._line("coarse", {**FACTS, "peak_memory_mb": 123.4})
    assert told == "coarse is done: 3,456 Gaussians, 12 steps, 7 s, peak memory 123 MB"


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"poses": PoseConfig(refine=True)}, "--refine-poses"),
        ({"exposure": ExposureConfig(learn=True)}, "--exposure"),
        ({"cell": CellConfig(views=("a",))}, "--cell"),
        ({"guidance": GuidanceConfig(prior="sd21", lambda_sds=0.1)}, "--prior sd21"),
        ({"guidance": GuidanceConfig(prior="sd21", lambda_sds=0.0)}, ""),
        ({}, ""),
    ],
)
def test_what_would_give_every_cell_its_own_world_is_refused(changes: dict[str, Any], flag: str) -> None:
    config = replace(TrainConfig(), **changes)
    if flag:
        with pytest.raises(UsageError, match=f"`--cells` and `{flag}` do not go together"):
            driver.require_plain(config)
    else:
        driver.require_plain(config)


@pytest.fixture(scope="module")
def scene(dataset: Path) -> Scene:
    return load_scene(str(dataset))


def sized(scene: Scene, directory: RunDirectory) -> tuple[int, bool, int]:
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0), cells="2")
    return driver._sizes(config, scene, directory)


@pytest.mark.parametrize("polished", [True, False])
def test_sizes_are_decided_once_and_a_polish_that_does_not_fit_is_told(
    scene: Scene, directory: RunDirectory, monkeypatch: pytest.MonkeyPatch, polished: bool
) -> None:
    told: list[tuple[str, str]] = []
    monkeypatch.setattr(directory, "emit", lambda kind, **fields: told.append((kind, fields["message"])))
    monkeypatch.setattr(driver, "cell_sizes", lambda *_: SimpleNamespace(count=3, polished=polished))
    assert sized(scene, directory) == (3, polished, 90)
    assert [kind for kind, _ in told] == ["cells"] + ["warning"] * (not polished)
    assert directory.recorded("gaussians_init") == "3 cells of a coarse run"
    assert directory.recorded("train_views") == [view.name for view in scene.train]
    monkeypatch.setattr(driver, "cell_sizes", None)
    assert sized(scene, directory) == (3, polished, 90)
    with pytest.raises(InputError, match="other views than when the run began"):
        sized(replace(scene, train=scene.train[:3]), directory)


@pytest.mark.parametrize(
    ("changed", "fine"),
    [
        ({}, True),
        ({"count": 2}, True),
        ({"count": 5}, True),
        ({"count": 1}, False),
        ({"count": 6}, False),
        ({"count": 3.0}, False),
        ({"max_gaussians": 1}, True),
        ({"max_gaussians": 0}, False),
        ({"max_gaussians": "9"}, False),
    ],
)
def test_recorded_sizes_are_checked(scene: Scene, directory: RunDirectory, changed: Any, fine: bool) -> None:
    record = {"count": 3, "polished": 1, "max_gaussians": 90, **changed}
    directory.record(cells=record, train_views=[view.name for view in scene.train])
    if fine:
        assert sized(scene, directory) == (record["count"], True, record["max_gaussians"])
    else:
        with pytest.raises(InputError, match=r"`cells` in .* is garbled"):
            sized(scene, directory)


def test_merged_gaussians_are_those_of_each_cell_within_its_bounds(tmp_path: Path) -> None:
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    inf = float("inf")
    left = Cell("00", (-inf, -inf), (0.0, inf), (0.1, 0.1), ("a",), 9)
    right = Cell("01", (0.0, -inf), (inf, inf), (0.1, 0.1), ("a",), 9)
    splats = [cloud(40, seed) for seed in (1, 2)]
    for cell, one in zip((left, right), splats, strict=True):
        (tmp_path / "cells" / cell.name).mkdir(parents=True)
        save_ply(tmp_path / "cells" / cell.name / "splat.ply", one)
    found = driver._merged(CellPlan("", axes, (left, right)), tmp_path).means
    expected = [splats[0].means[splats[0].means[:, 0] < 0], splats[1].means[splats[1].means[:, 0] >= 0]]
    torch.testing.assert_close(found, torch.cat(expected))
    only_right = driver._merged(CellPlan("", axes, (replace(left, high=(-99.0, inf)), right)), tmp_path)
    torch.testing.assert_close(only_right.means, expected[1])


@pytest.mark.parametrize(("polished", "stopped"), [(True, False), (False, False), (True, True)])
def test_a_run_in_cells_is_coarse_then_cells_then_polished(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, polished: bool, stopped: bool
) -> None:
    """A stopped one has no splats, and says how far it came."""
    done: list[str] = []

    class Doing:
        def __init__(self, directory: Any, farm: Any, stop: Any, threads: int) -> None:
            done.append(f"{farm} {threads}")

        def run(self, stages: list[Stage]) -> None:
            done.extend(stage.name for stage in stages)
            if stopped:
                raise Stopped
            if stages[0].name == "polish":
                save_ply(tmp_path / "polish" / "splat.ply", cloud(7, 3))

        def total(self, fact: str) -> float:
            return {"steps": 41.0, "seconds": 1.23456, "cpu_seconds": 2.5}[fact]

        def most(self, fact: str) -> None:
            return None

    plan = CellPlan(
        "", (), (Cell("00", (0, 0), (1, 1), (0, 0), ("a",), 9), Cell("01", (0, 0), (1, 1), (0, 0), ("b",), 9))
    )
    monkeypatch.setattr(driver, "open_farm", lambda name, threads: name)
    monkeypatch.setattr(
        driver, "load_with_agreeing_masks", lambda data: (done.append(f"{data.cache_mb} MB"), (scene, []))[1]
    )
    monkeypatch.setattr(driver, "_sizes", lambda *_: (2, polished, 90))
    monkeypatch.setattr(driver, "_plan", lambda *_: plan)
    monkeypatch.setattr(driver, "_merged", lambda *_: cloud(9, 1))
    monkeypatch.setattr(driver, "Stages", Doing)
    monkeypatch.setattr(driver, "peak_memory_mb", lambda: 55.0)
    config = replace(tiny_config(Path("unused"), cells="2"), threads=2)
    found = driver.train_in_cells(config, tmp_path, "farm")
    assert done[:3] == ["64 MB", "farm 2", "coarse"]
    assert done[3:] == ([] if stopped else ["cells/00", "cells/01"] + ["polish"] * polished)
    assert len(found.gaussians) == (0 if stopped else 7 if polished else 9)
    assert (found.stopped, found.steps, found.train_seconds, found.cpu_seconds) == (stopped, 41, 1.23456, 2.5)
    assert found.peak_memory_mb == 55.0
    assert (tmp_path / "splat.ply").is_file() != stopped
    last = json.loads((tmp_path / "events.jsonl").read_text().splitlines()[-1]) if stopped else {}
    assert not stopped or (last["kind"], last["step"], last["seconds"]) == ("stopped", 41, 1.235)


def test_cells_that_do_not_go_together_with_a_setting_are_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "open_farm", None)
    with pytest.raises(UsageError, match="--refine-poses"):
        driver.train_in_cells(replace(TrainConfig(), poses=PoseConfig(refine=True)), tmp_path / "run", "local")
    assert not (tmp_path / "run").exists()


def test_a_plan_is_made_once_after_the_splats_that_its_runs_begin_with(
    scene: Scene, directory: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each cell begins with its part of the coarse model, margin included, beside what its views see outside."""
    coarse = cloud(30, 1)
    (directory.path / "coarse").mkdir()
    save_ply(directory.path / "coarse" / "splat.ply", coarse)
    inf = float("inf")
    names = tuple(view.name for view in scene.train)
    cells = (
        Cell("00", (-inf, -inf), (0.0, inf), (0.1, 0.1), names[:2], 9),
        Cell("01", (0.0, -inf), (inf, inf), (0.1, 0.1), names[1:], 9),
    )
    outside = (torch.arange(30) < 3, torch.arange(30) < 5)
    asked: list[Any] = []

    def divide(splats: Any, sha: str, views: Any, backend: Any, count: int, most: int) -> Any:
        asked.append((len(splats), len(views), count, most))
        plan = CellPlan(sha, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), cells)
        return SimpleNamespace(plan=plan, surroundings=outside)

    monkeypatch.setattr(driver, "divide", divide)
    config = tiny_config(Path("unused"), cells="2")
    for _ in range(2):
        found = driver._plan(config, scene, directory, 2, 77)
        assert found.cells == cells
    assert asked == [(30, len(names), 2, 77)]
    for cell, frozen, wide in zip(cells, outside, (coarse.means[:, 0] < 0.1, coarse.means[:, 0] >= -0.1), strict=True):
        folder = directory.path / "cells" / cell.name
        torch.testing.assert_close(driver.load_splats(folder / "start.ply").means, coarse.means[wide])
        torch.testing.assert_close(driver.load_splats(folder / "frozen.ply").means, coarse.means[frozen])


def test_a_run_that_ended_before_its_first_cell_has_no_gaussians() -> None:
    none = driver._none()
    assert len(none) == 0
    assert none.validate().sh_degree == 0
    assert len(none.append(replace(cloud(3, 1), shN=torch.zeros(3, 0, 3)))) == 3
