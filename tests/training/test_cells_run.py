"""A run in cells is a finished run as any other, the same for any farm, and after a stop or a kill."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tiny_scenes import tiny_config, write_dataset

from gsopt import cli
from gsopt.config.train import DensityConfig, SparseConfig, TrainConfig
from gsopt.errors import InputError, UsageError
from gsopt.events import read_events
from gsopt.farm.job import Job, Outcome
from gsopt.formats import load_splats
from gsopt.training.cells import run as cells_run
from gsopt.training.cells import stages
from gsopt.training.cells.plan import read_plan
from gsopt.training.cells.size import cell_sizes
from gsopt.training.cells.worker import handle
from gsopt.training.plan import RunPlan
from gsopt.training.reconstruct import reconstruct

STAGES = ["cells/00", "cells/01", "coarse", "polish"]
FLAGS = ["--iterations", "40", "--init", "random", "--init-count", "60", "--max-gaussians", "90", "--cells", "2"]
FLAGS += ["--sparse.below-views", "0", "--checkpoint-every", "5", "--preview-every", "0", "--threads", "1"]


class Here:
    """A farm in this process: its jobs take no seconds to start."""

    def run(self, jobs: Sequence[Job], report: Any = None) -> Iterator[Outcome]:
        for job in jobs:
            self.before(job)
            try:
                yield Outcome(job, "done", handle(json.loads(json.dumps(job.request))), host="here")
            except InputError as error:
                yield Outcome(job, "failed", error=str(error))

    def before(self, job: Job) -> None:
        """A test may do something here."""


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    farm = Here()
    monkeypatch.setattr(cells_run, "open_farm", lambda name, cpus: farm)
    return farm


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("cells") / "cloud", train=6, test=1)


def config_of(data: Path, **changes: Any) -> TrainConfig:
    return replace(
        tiny_config(data), sparse=SparseConfig(below_views=0), iterations=40, cells="2", threads=1, **changes
    )


@pytest.fixture(scope="module")
def whole(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run by the command line, on two workers."""
    run = tmp_path_factory.mktemp("whole") / "run"
    assert cli.main(["train", str(data), "-m", str(run), *FLAGS, "--farm", "local:2"]) == 0
    return run


def splats(run: Path) -> bytes:
    return (run / "splat.ply").read_bytes()


def test_it_is_a_finished_run(whole: Path, data: Path) -> None:
    metrics = json.loads((whole / "metrics.json").read_bytes())
    recorded = json.loads((whole / "config.json").read_bytes())
    assert metrics["mean"]["psnr"] > 10
    assert (whole / "report.html").is_file()
    assert sorted(recorded["stages"]) == STAGES
    assert metrics["steps"] == sum(stage["steps"] for stage in recorded["stages"].values())
    assert metrics["n_gaussians"] == len(load_splats(whole / "splat.ply")) == recorded["stages"]["polish"]["n"]
    events = read_events(whole / "events.jsonl")[0]
    assert events[-1]["kind"] == "done"
    assert "2 cells, estimate: about" in events[0]["message"]  # before anything starts
    assert next(event["stage"] for event in events if "stage" in event) == "coarse"


def test_every_gaussian_before_the_polish_is_that_of_the_cell_it_lies_in(whole: Path) -> None:
    names = {f"train/r_{i}.png": 1 for i in range(6)}
    plan = read_plan(whole / "plan.json", whole / "coarse" / "splat.ply", names, 2)
    merged = load_splats(whole / "polish" / "start.ply")
    counts = []
    for cell in plan.cells:
        own = load_splats(whole / "cells" / cell.name / "splat.ply")
        counts.append(int(cell.holds(plan.places(own.means)).sum()))
        assert counts[-1] < len(own)  # something beyond the border is left out
        assert len(own) <= cell.max_gaussians
    assert [int(cell.holds(plan.places(merged.means)).sum()) for cell in plan.cells] == counts
    assert len(merged) == sum(counts)


def test_another_farm_gives_the_same_bits(whole: Path, data: Path, tmp_path: Path, here: Here) -> None:
    assert cli.main(["train", str(data), "-m", str(tmp_path / "run"), *FLAGS]) == 0
    assert splats(tmp_path / "run") == splats(whole)
    assert (tmp_path / "run" / "plan.json").read_bytes() == (whole / "plan.json").read_bytes()


def test_a_killed_driver_goes_on_to_the_same_bits(whole: Path, data: Path, tmp_path: Path, here: Here) -> None:
    run = tmp_path / "run"
    words = ["train", str(data), "-m", str(run), *FLAGS]
    driver = subprocess.Popen(
        [sys.executable, "-m", "gsopt", *words], stdout=subprocess.DEVNULL, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not (run / "cells" / "00" / "config.json").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    assert not (run / "splat.ply").exists()
    kept = (run / "coarse" / "splat.ply").stat().st_mtime_ns
    deadline = time.monotonic() + 30
    while (code := cli.main(words)) == UsageError.exit_code and time.monotonic() < deadline:
        time.sleep(0.1)  # its worker has not yet noticed that nobody listens
    assert code == 0
    assert splats(run) == splats(whole)
    assert (run / "coarse" / "splat.ply").stat().st_mtime_ns == kept


def test_a_stop_reaches_the_stage_that_is_under_way(
    data: Path, tmp_path: Path, here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "POLL_SECONDS", 0.01)
    run, reached = tmp_path / "run", []

    def stop(job: Job) -> None:
        (run / job.name).mkdir(parents=True)
        (run / "stop").touch()
        deadline = time.monotonic() + 30
        while not (run / job.name / "stop").exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        reached.append((run / job.name / "stop").exists())
        raise InputError("The rest of this run is another test's.")

    here.before = stop  # type: ignore[method-assign]
    assert cli.main(["train", str(data), "-m", str(run), *FLAGS]) == InputError.exit_code
    assert reached == [True]


@pytest.mark.parametrize("stage", ["cells/01", "polish"])
def test_stopped_then_resumed_is_the_run_that_was_never_stopped(
    stage: str, whole: Path, data: Path, tmp_path: Path, here: Here, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    here.before = lambda job: (run / "stop").touch() if job.name == stage else None  # type: ignore[method-assign]
    assert cli.main(["train", str(data), "-m", str(run), *FLAGS]) == 0
    assert read_events(run / "events.jsonl")[0][-1]["kind"] == "stopped"
    assert "continue with: gsopt train --resume" in capsys.readouterr().out
    assert not (run / "splat.ply").exists()
    here.before = lambda job: None  # type: ignore[method-assign]
    assert cli.main(["train", "--resume", "-m", str(run)]) == 0
    assert splats(run) == splats(whole)


def test_a_stage_that_fails_is_named_and_the_others_are_kept(
    whole: Path, data: Path, tmp_path: Path, here: Here, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    here.before = lambda job: (run / job.name / "frozen.ply").write_bytes(b"x") if job.name == "cells/00" else None  # type: ignore[method-assign]
    words = ["train", str(data), "-m", str(run), *FLAGS]
    assert cli.main(words) == InputError.exit_code
    told = capsys.readouterr().err
    assert "cells/00 failed: " in told
    assert "The same command goes on" in told
    assert sorted(json.loads((run / "config.json").read_bytes())["stages"]) == ["cells/01", "coarse"]


def test_the_polish_is_left_out_where_memory_does_not_suffice(data: Path, tmp_path: Path, here: Here) -> None:
    from gsopt.data.scene import load_scene

    config = config_of(data, density=DensityConfig(max_gaussians=4000, refine_start=4, refine_every=5))
    config = replace(config, cells="4")
    scene = load_scene(config.data)
    sizes = cell_sizes(config, RunPlan.of(config, scene), scene)
    found = reconstruct(None, tmp_path / "run", config=replace(config, max_memory=f"{sizes.polish.memory - 1}B"))
    warnings = [e["message"] for e in read_events(tmp_path / "run" / "events.jsonl")[0] if e["kind"] == "warning"]
    assert any("joint polish does not fit" in text for text in warnings)
    assert found.metrics is not None
    assert not (tmp_path / "run" / "polish").exists()
    assert len(found.gaussians) == len(load_splats(tmp_path / "run" / "splat.ply"))


@pytest.mark.parametrize("cells", ["0", "1", "-1", "1000", "two", "2.5"])
def test_a_wrong_number_of_cells_is_a_usage_error(
    cells: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", str(data), "-m", str(tmp_path / "run"), f"--cells={cells}"]) == UsageError.exit_code
    told = capsys.readouterr().err
    assert "`--cells` must be auto or a number from 2 to 999" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("flags", [["--refine-poses"], ["--exposure"], ["--prior", "library"]])
def test_what_does_not_go_with_cells_is_refused(
    flags: list[str], data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(data), "-m", str(tmp_path / "run"), "--cells", "2", *flags]
    assert cli.main(words) == UsageError.exit_code
    assert f"`--cells` and `{flags[0]}" in capsys.readouterr().err


def test_a_farm_without_cells_or_an_unknown_one_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", str(data), "-m", str(tmp_path / "run"), "--farm"]
    assert cli.main([*words, "local:2"]) == UsageError.exit_code
    assert "`--farm` is for runs in cells" in capsys.readouterr().err
    assert cli.main([*words, "slurm", "--cells", "2"]) == UsageError.exit_code
    assert "`--farm` must be local" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_few_photos_are_refused_before_any_work(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags in (["--cells", "2"], ["--cells", "auto", "--views", "1"]):
        assert cli.main(["train", str(data), "-m", str(tmp_path / "run"), *flags]) == UsageError.exit_code
        assert "`--cells` is for big scenes" in capsys.readouterr().err
    assert not (tmp_path / "run" / "coarse").exists()


def test_a_strangers_plan_is_not_followed(whole: Path, data: Path, tmp_path: Path, capsys: Any, here: Here) -> None:
    foreign, run = tmp_path / "foreign", tmp_path / "run"
    foreign.mkdir()
    shutil.copy(whole / "plan.json", foreign)
    words = ["train", str(data), *FLAGS, "-m"]
    assert cli.main([*words, str(foreign)]) == UsageError.exit_code
    assert "holds another run (plan.json)" in capsys.readouterr().err
    shutil.copytree(whole, run)
    document = json.loads((run / "plan.json").read_bytes())
    (run / "plan.json").write_text(json.dumps({**document, "coarse": "0" * 64}))
    before = splats(run)
    assert cli.main(["train", "--resume", "-m", str(run)]) == InputError.exit_code
    assert "plan.json does not fit this run: it is that of another run" in capsys.readouterr().err
    assert splats(run) == before
    recorded = json.loads((run / "config.json").read_bytes())
    for key, value in (("cells", {"count": 10**9}), ("cells", [2]), ("stages", 5)):
        (run / "config.json").write_text(json.dumps({**recorded, key: value}))
        assert cli.main(["train", "--resume", "-m", str(run)]) == InputError.exit_code
        assert "is garbled" in capsys.readouterr().err
    assert cli.main([*words, str(run), "--seed", "5"]) == UsageError.exit_code  # another run, not this one


def test_train_itself_knows_no_cells(data: Path, tmp_path: Path) -> None:
    from gsopt.training.loop import train

    with pytest.raises(UsageError, match="is for `gsopt train` and reconstruct"):
        train(config_of(data), tmp_path / "run")
