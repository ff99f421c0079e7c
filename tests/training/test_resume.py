"""A run that was stopped or killed and resumed is the run that was not: the same bytes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from run_configs import HANGUP, configs
from tiny_scenes import tiny_config

from gsopt.config.train import TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import read_events
from gsopt.training import loop
from gsopt.training.checkpoint import read_checkpoint, save_checkpoint, saved
from gsopt.training.loop import train
from gsopt.training.plan import RunPlan
from gsopt.training.schedule import Flatness
from gsopt.training.trainer import Trainer

KILLED_RUN = Path(__file__).with_name("killed_run.py")
MOMENTS = (
    "while config.json is completed",
    "in the middle of a step",
    "between writing a checkpoint and renaming it",
    "between the last checkpoint and the splats",
)


class Killed(BaseException):
    """Stands for a death in the middle of a step."""


NAMES = (
    "adc",
    "turnover",
    "mcmc",
    "few views",
    "random background",
    "reference backend",
    "coarse to fine",
    "skipping",
    "refined poses",
    "learned exposure",
    "opaque photos",
)


@pytest.fixture(scope="module")
def whole(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """splat.ply of every uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole")
    return {name: run_bytes(config, folder / name) for name, config in configs(dataset).items()}


def run_bytes(config: TrainConfig, run: Path, resume: bool = False) -> bytes:
    train(config, run, resume=resume)
    return (run / "splat.ply").read_bytes()


def kinds(run: Path) -> list[str]:
    return [event["kind"] for event in read_events(run / "events.jsonl")[0]]


def act_at(monkeypatch: pytest.MonkeyPatch, step: int, act) -> None:
    """Call `act` in the middle of a step."""
    original = Trainer._update

    def update(trainer: Trainer, *args) -> None:
        if trainer.step == step:
            act()
        original(trainer, *args)

    monkeypatch.setattr(Trainer, "_update", update)


def test_the_runs_differ_from_each_other(whole: dict[str, bytes]) -> None:
    assert len(set(whole.values())) == len(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_settings_give_the_same_bytes_for_any_number_of_threads(
    name: str, dataset: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        config = replace(configs(dataset)[name], threads=2, checkpoint_every=0, preview_every=7)
        assert run_bytes(config, tmp_path / "again") == whole[name]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_another_seed_gives_other_bytes(dataset: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    assert run_bytes(replace(configs(dataset)["adc"], seed=1), tmp_path / "run") != whole["adc"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("step", [3, 16])
def test_stopped_then_resumed_is_the_run_that_was_never_stopped(
    name: str, step: int, dataset: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, config = tmp_path / "run", configs(dataset)[name]
    with monkeypatch.context() as patch:
        act_at(patch, step, (run / "stop").touch)
        result = train(config, run)
    assert (result.stopped, result.steps, kinds(run)[-1]) == (True, step, "stopped")
    assert (run / "splat.ply").read_bytes() != whole[name]
    assert run_bytes(config, run, resume=True) == whole[name]
    assert kinds(run)[-1] == "done"
    assert not (run / "stop").exists()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("step", [5, 11, 30])
def test_dead_in_the_middle_of_a_step_then_resumed(
    name: str, step: int, dataset: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die() -> None:
        raise Killed

    run, config = tmp_path / "run", configs(dataset)[name]
    with monkeypatch.context() as patch:
        act_at(patch, step, die)
        with pytest.raises(Killed):
            train(config, run)
    assert not (run / "splat.ply").exists()
    assert run_bytes(config, run, resume=True) == whole[name]
    assert kinds(run).count("started") == 2


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_then_resumed(moment: str, dataset: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    run, config = tmp_path / "run", configs(dataset)["few views"]
    file = tmp_path / "config.json"
    file.write_text(json.dumps(config.to_dict()))
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # the helpers of tests/ too
    done = subprocess.run([sys.executable, str(KILLED_RUN), str(file), str(run), moment], check=False, env=paths)
    assert done.returncode == -signal.SIGKILL
    assert not {"done", "stopped", "error"} & set(kinds(run))
    leftovers = [path.name for path in run.rglob(".*.tmp")]
    assert bool(leftovers) == ("config.json" in moment or "renaming" in moment)
    assert run_bytes(config, run, resume=True) == whole["few views"]
    assert list(run.rglob(".*.tmp")) == []  # nothing half-written is left


@pytest.mark.parametrize("when", ["before", "after"])
def test_no_preview_is_lost_by_a_death_at_a_checkpoint(
    when: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def save(folder: Path, step: int, *args: Any) -> Path:
        if step == 10 and when == "before":
            raise Killed
        path = save_checkpoint(folder, step, *args)
        if step == 10:
            raise Killed
        return path

    config = replace(configs(dataset)["adc"], checkpoint_every=5, preview_every=5, iterations=15)
    with monkeypatch.context() as patch:
        patch.setattr(loop, "save_checkpoint", save)
        with pytest.raises(Killed):
            train(config, tmp_path / "run")
    train(config, tmp_path / "run", resume=True)
    events, _ = read_events(tmp_path / "run" / "events.jsonl")
    assert {event["step"] for event in events if event["kind"] == "preview"} == {5, 10, 15}
    assert len(list((tmp_path / "run" / "previews").iterdir())) == 3


def test_a_broken_checkpoint_is_told_and_the_one_before_is_used(
    dataset: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    run, config = tmp_path / "run", configs(dataset)["adc"]
    train(config, run)
    newest, older = saved(run / "checkpoints")
    newest.write_bytes(newest.read_bytes()[:-100])
    (run / "splat.ply").unlink()
    assert run_bytes(config, run, resume=True) == whole["adc"]
    events, _ = read_events(run / "events.jsonl")
    warnings = [event["message"] for event in events if event["kind"] == "warning"]
    assert any(newest.name in message for message in warnings)
    restarted = [event["step"] for event in events if event["kind"] == "started"]
    assert restarted == [0, read_checkpoint(older).meta["step"]]


HOSTILE: dict[str, Callable[[dict, dict], object]] = {
    "step beyond the end": lambda tensors, meta: meta.update(step=10**9),
    "step of 400 digits": lambda tensors, meta: meta.update(step=10**400),
    "step as text": lambda tensors, meta: meta.update(step="7"),
    "negative Adam steps": lambda tensors, meta: meta["adam_steps"].update(means=-1),
    "Adam steps of 400 digits": lambda tensors, meta: meta["adam_steps"].update(sh0=10**400),
    "no Adam steps": lambda tensors, meta: meta.update(adam_steps=[]),
    "position before the epoch": lambda tensors, meta: meta.update(epoch_position=-(10**9)),
    "seconds of 400 digits": lambda tensors, meta: meta.update(seconds=10**400),
    "seconds as a list": lambda tensors, meta: meta.update(cpu_seconds=[]),
    "flatness as text": lambda tensors, meta: meta["flatness"].update(total="1"),
    "shown as text": lambda tensors, meta: meta["shown"].update(loss="1"),
    "shown of 400 digits": lambda tensors, meta: meta["shown"].update(mse=10**400),
    "no list of shown": lambda tensors, meta: meta.update(shown=None),
    "a view that is not there": lambda tensors, meta: tensors["epoch.order"].fill_(99),
    "a view before the first": lambda tensors, meta: tensors["epoch.order"].fill_(-99),
    "an order of floats": lambda tensors, meta: tensors.update({"epoch.order": torch.rand(5)}),
    "an order of no axis": lambda tensors, meta: tensors.update({"epoch.order": torch.tensor(3)}),
    "statistics of fewer": lambda tensors, meta: tensors.update({"density.grad_sum": torch.rand(3)}),
    "statistics of another type": lambda tensors, meta: tensors.update({"density.seen": tensors["density.seen"] > 0}),
    "means of no axis": lambda tensors, meta: tensors.update({"gaussians.means": torch.tensor(3.0)}),
    "no Gaussians": lambda tensors, meta: tensors.update({k: v[:0] for k, v in tensors.items() if "gaussians" in k}),
    "moments of two axes": lambda tensors, meta: tensors.update({"exp_avg.shN": torch.rand(60, 3)}),
    "resting views of another run": lambda tensors, meta: tensors.update({"resting.last": torch.rand(2)}),
    "a band too high": lambda tensors, meta: tensors.update({"bands.degree": torch.tensor(9)}),
    "sums without their names": lambda tensors, meta: tensors.update({"bands.n": torch.rand(0)}),
    "a short generator": lambda tensors, meta: tensors.update({"rng.views": tensors["rng.views"][:9]}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_checkpoint_is_an_input_error(name: str, stopped_run: Path, dataset: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(stopped_run, run)
    (path,) = saved(run / "checkpoints")
    found = read_checkpoint(path)
    tensors, meta = dict(found.tensors), json.loads(json.dumps(found.meta))
    HOSTILE[name](tensors, meta)
    save_checkpoint(path.parent, found.meta["step"], tensors, meta)
    with pytest.raises(InputError, match=path.name):
        train(configs(dataset)["skipping"], run, resume=True)


@pytest.fixture(scope="module")
def stopped_run(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped after 13 steps, with one checkpoint."""
    run = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.MonkeyPatch.context() as patch:
        act_at(patch, 13, (run / "stop").touch)
        train(replace(configs(dataset)["skipping"], checkpoint_every=0), run)
    return run


def test_a_finished_run_resumed_is_left_as_it_is(dataset: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    run, config = tmp_path / "run", configs(dataset)["adc"]
    first = train(config, run)
    again = train(config, run, resume=True)
    assert (run / "splat.ply").read_bytes() == whole["adc"]
    assert again.steps == first.steps == config.iterations
    assert not again.stopped


def test_other_settings_are_refused_on_resume_but_threads_may_change(dataset: Path, tmp_path: Path) -> None:
    run, config = tmp_path / "run", configs(dataset)["adc"]
    train(config, run)
    before = (run / "events.jsonl").read_bytes()
    with pytest.raises(UsageError, match=r"`density.growth` was 1.05, now 1.5"):
        train(replace(config, density=replace(config.density, growth=1.5)), run, resume=True)
    with pytest.raises(UsageError, match=r"`seed` was 0, now 9"):  # after a part with a setting that may change
        train(replace(config, data=replace(config.data, cache_mb=1), seed=9), run, resume=True)
    assert (run / "config.json").exists()
    assert (run / "events.jsonl").read_bytes().startswith(before)
    train(replace(config, threads=3, preview_every=0), run, resume=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, HANGUP])
def test_a_signal_lets_the_step_finish_and_saves(
    number: signal.Signals, dataset: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, config = tmp_path / "run", configs(dataset)["adc"]
    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        act_at(patch, 8, lambda: signal.raise_signal(number))
        result = train(config, run)
    assert (result.stopped, result.steps) == (True, 8)
    assert signal.getsignal(number) is before
    assert run_bytes(config, run, resume=True) == whole["adc"]


def test_what_killed_writers_left_is_swept(stopped_run: Path, dataset: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(stopped_run, run)
    for name in (".", "previews", "checkpoints", "guidance", "renders/test", "renders/train"):
        (run / name).mkdir(parents=True, exist_ok=True)
        for left in (".splat.ply.123.tmp", ".tmpq1W2e3"):
            (run / name / left).write_bytes(b"half")
        (run / name / "mine.tmp").write_bytes(b"whole")
    train(replace(configs(dataset)["skipping"], checkpoint_every=0), run, resume=True)
    assert {path.name for path in run.rglob("*tmp*")} == {"mine.tmp"}


def test_a_second_interrupt_does_not_wait(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def twice() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    act_at(monkeypatch, 8, twice)
    with pytest.raises(KeyboardInterrupt):
        train(configs(dataset)["adc"], tmp_path / "run")
    events, _ = read_events(tmp_path / "run" / "events.jsonl")
    assert (events[-1]["kind"], events[-1]["exit_code"]) == ("error", 130)


def test_early_end_is_remembered(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Flatness, "update", lambda self, loss: True)
    config = replace(configs(dataset)["coarse to fine"], optimizer=replace(tiny_config(dataset).optimizer, sh_degree=0))
    first = train(config, tmp_path / "run")
    settling = RunPlan.of(config, load_scene(config.data)).schedule.settling
    assert settling > 0
    assert first.steps == 26 + settling  # the first step after refine_stop
    assert not first.stopped
    again = train(config, tmp_path / "run", resume=True)
    assert again.steps == first.steps
    many = replace(config, sparse=replace(config.sparse, below_views=0))
    assert train(many, tmp_path / "many").steps == 26 + RunPlan.of(many, load_scene(many.data)).schedule.settling
