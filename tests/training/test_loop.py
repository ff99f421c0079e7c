"""`train` and its run directory: files, events, and errors when something is wrong."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud, tiny_config

from gsopt.config.train import DataConfig, DensityConfig, LossConfig, OptimizerConfig, SparseConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import GsoptError, InputError, NumericalError, UsageError
from gsopt.events import EventWriter, read_events
from gsopt.formats import load_splats
from gsopt.init import first_gaussians
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings
from gsopt.training import loop
from gsopt.training.loop import train
from gsopt.training.run_directory import first_difference
from gsopt.training.targets import Targets
from gsopt.training.trainer import Trainer


@pytest.fixture(scope="module")
def finished(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("finished") / "deep" / "run"
    train(tiny_config(dataset), run)
    return run


def events(run: Path) -> list[dict]:
    return read_events(run / "events.jsonl")[0]


def loss_of(gaussians, dataset: Path) -> float:
    scene, backend, white = load_scene(DataConfig(path=str(dataset))), make_backend("reference"), torch.ones(3)
    targets = [Targets(scene.train, white, 0).get(i, 1, white) for i in range(len(scene.train))]
    settings = RasterSettings(sh_degree=gaussians.sh_degree)
    frames = [backend.forward(gaussians, target.camera, settings, white) for target in targets]
    return sum(backend.photometric(f.colors, t.colors, 0.2).loss for f, t in zip(frames, targets, strict=True))


@pytest.mark.parametrize("strategy", ["adc", "mcmc"])
def test_training_brings_the_splats_closer_to_the_views(strategy: str, dataset: Path, tmp_path: Path) -> None:
    density = DensityConfig(strategy=strategy, refine_start=10, refine_every=20, max_gaussians=90)  # type: ignore[arg-type]
    config = tiny_config(
        dataset, density=density, iterations=80, sparse=SparseConfig(below_views=0), backend="reference"
    )
    result = train(config, tmp_path / "run")
    scene = load_scene(config.data)
    before, _ = first_gaussians(scene, config.init, 3, config.seed)
    assert loss_of(result.gaussians, dataset) < 0.6 * loss_of(before, dataset)


def test_the_run_directory_holds_what_the_protocol_says(finished: Path, dataset: Path) -> None:
    document = json.loads((finished / "config.json").read_text())
    assert TrainConfig.from_dict(document["config"]) == tiny_config(dataset)
    assert {"gsopt", "torch", "python"} <= set(document["versions"])
    assert isinstance(document["gaussians_init"], str)
    assert [path.name for path in sorted((finished / "previews").iterdir())] == ["step_000015.ply", "step_000030.ply"]
    assert [path.name for path in sorted((finished / "checkpoints").iterdir())] == [
        "step_000020.safetensors",
        "step_000030.safetensors",
    ]
    assert len(load_splats(finished / "splat.ply")) == events(finished)[-1]["n"] <= 90


def test_the_events_tell_the_run_in_order(finished: Path) -> None:
    told = events(finished)
    assert [event["seq"] for event in told] == list(range(len(told)))
    assert told[0]["kind"] == "started"
    assert (told[0]["total"], told[0]["train_views"], told[0]["test_views"]) == (30, 5, 2)
    assert told[-1]["kind"] == "done"
    assert {event["kind"] for event in told[1:-1]} == {"preview", "progress"}
    last = [event for event in told if event["kind"] == "progress"][-1]
    assert last["step"] == last["total"] == 30
    assert last["loss"] > 0
    assert 0 < last["psnr"] < 100
    for event in told:
        if event["kind"] == "preview":
            assert (finished / event["path"]).is_file()


def test_a_listener_hears_every_event(dataset: Path, tmp_path: Path) -> None:
    heard: list[dict] = []
    train(tiny_config(dataset), tmp_path / "run", on_progress=heard.append, done=False)
    assert heard == events(tmp_path / "run")
    assert heard[-1]["kind"] != "done"


def test_a_folder_with_another_run_is_left_alone(finished: Path, dataset: Path) -> None:
    before = {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()}
    with pytest.raises(UsageError, match="--resume"):
        train(tiny_config(dataset), finished)
    assert {path: path.read_bytes() for path in finished.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("work", ["splat.ply", "report.html", "metrics.json", "previews/step_000500.ply"])
def test_any_result_makes_a_folder_another_run(work: str, dataset: Path, tmp_path: Path) -> None:
    (tmp_path / work).parent.mkdir(exist_ok=True)
    (tmp_path / work).write_text("precious")
    with pytest.raises(UsageError, match=Path(work).name):
        train(tiny_config(dataset), tmp_path)
    assert (tmp_path / work).read_text() == "precious"


def test_a_run_whose_data_was_wrong_says_so_and_can_be_started_again(dataset: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(InputError):
        train(tiny_config(dataset, data=DataConfig(path=str(tmp_path / "typo"))), run)
    last = events(run)[-1]
    assert (last["kind"], last["exit_code"]) == ("error", 3)
    assert "typo" in last["message"]
    train(tiny_config(dataset), run)
    assert events(run)[-1]["kind"] == "done"


def test_a_bug_is_an_error_event_too(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Trainer, "_update", lambda *args: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(tiny_config(dataset), tmp_path / "run")
    last = events(tmp_path / "run")[-1]
    assert (last["kind"], last["exit_code"]) == ("error", 1)
    assert "ZeroDivisionError" in last["message"]


@pytest.mark.parametrize("failing", ["preview", "progress"])
def test_a_disk_full_at_an_event_loses_no_step(
    failing: str, dataset: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run ends with a checkpoint of its last step and whole lines; resumed, it ends in the same bytes."""
    real, steps = os.write, []

    def write(descriptor: int, data: bytes) -> int:
        event = json.loads(data)
        if event["kind"] == failing and not steps:
            steps.append(event["step"])
            raise OSError(28, "No space left on device")
        return real(descriptor, data)

    monkeypatch.setattr(os, "write", write)
    with pytest.raises(InputError, match=r"No space left on device.*--resume"):
        train(tiny_config(dataset), tmp_path / "run")
    assert (tmp_path / f"run/checkpoints/step_{steps[0]:06d}.safetensors").is_file()
    assert events(tmp_path / "run")[-1]["kind"] == "error"
    train(tiny_config(dataset), tmp_path / "run", resume=True)
    assert [event["seq"] for event in events(tmp_path / "run")] == list(range(len(events(tmp_path / "run"))))
    assert (tmp_path / "run/splat.ply").read_bytes() == (finished / "splat.ply").read_bytes()


@pytest.mark.parametrize("name", ["log.txt", "previews", "checkpoints", "guidance", "events.jsonl"])
def test_a_link_in_a_foreign_run_is_not_followed_on_resume(name: str, dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="symbolic link"):
        train(tiny_config(dataset), tmp_path / "run", resume=True)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_run_that_is_being_written_is_refused(dataset: Path, tmp_path: Path) -> None:
    writer = EventWriter(tmp_path)
    with pytest.raises(UsageError, match="Another process"):
        train(tiny_config(dataset), tmp_path)
    writer.close()
    train(tiny_config(dataset, iterations=1), tmp_path)


def test_a_run_folder_that_is_a_file_is_an_input_error(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    with pytest.raises(InputError, match="Choose another"):
        train(tiny_config(dataset), tmp_path / "file")
    assert (tmp_path / "file").read_text() == "precious"


def test_no_first_gaussians_is_an_input_error(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "first_gaussians", lambda *args: (cloud(0, 0), "hull"))
    with pytest.raises(InputError, match="`hull` made no Gaussians"):
        train(tiny_config(dataset), tmp_path / "run")


def test_more_first_gaussians_than_the_budget_are_thinned(dataset: Path, tmp_path: Path) -> None:
    config = tiny_config(dataset, density=DensityConfig(max_gaussians=17), iterations=2)
    assert len(train(config, tmp_path / "run").gaussians) == 17


@pytest.mark.parametrize("name", ["means", "shN", "logit_opacities"])
def test_a_nan_stops_the_run_and_names_itself_and_the_last_good_state(
    name: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = Trainer._update

    def poisoned(trainer: Trainer, *args) -> None:
        original(trainer, *args)
        if trainer.step == 19:
            getattr(trainer.model.gaussians, name)[3] = torch.nan

    monkeypatch.setattr(Trainer, "_update", poisoned)
    monkeypatch.setattr("gsopt.training.loop.require_finite_loss", lambda *args: None)
    config = tiny_config(dataset, density=DensityConfig(refine_start=10**6))
    with pytest.raises(NumericalError, match=rf"`{name}` became nan at index \[\d+.*step_000010.safetensors") as caught:
        train(config, tmp_path / "run")
    assert caught.value.exit_code == 4
    assert events(tmp_path / "run")[-1]["exit_code"] == 4
    assert not (tmp_path / "run" / "splat.ply").exists()


def test_a_loss_that_is_no_number_stops_at_once(dataset: Path, tmp_path: Path, monkeypatch) -> None:
    original = Trainer._gradients

    def lost(trainer: Trainer, *args):
        _, gradients = original(trainer, *args)
        return float("inf"), gradients

    monkeypatch.setattr(Trainer, "_gradients", lost)
    with pytest.raises(NumericalError, match=r"`loss` became inf on view .*r_\d.* in step 1\. No checkpoint"):
        train(tiny_config(dataset), tmp_path / "run")


def test_the_alpha_term_reaches_the_gradients(dataset: Path, tmp_path: Path) -> None:
    plain = tiny_config(dataset, iterations=5, sparse=SparseConfig(below_views=0))
    weighted = replace(plain, loss=LossConfig(lambda_alpha=1.0))
    a, b = (train(config, tmp_path / str(i)).gaussians for i, config in enumerate((plain, weighted)))
    assert not torch.equal(a.means, b.means)


def test_absolute_gradients_are_asked_for(dataset: Path, tmp_path: Path) -> None:
    def grown(absgrad: bool, run: Path) -> int:
        density = DensityConfig(
            refine_start=1, refine_every=5, refine_stop=5, absgrad=absgrad, grow_grad2d=4e-3, max_gaussians=200
        )
        return len(train(tiny_config(dataset, iterations=6, density=density), run).gaussians)

    assert grown(True, tmp_path / "a") > grown(False, tmp_path / "b")  # |x| + |y| >= |x + y|


def test_few_views_store_fewer_bands(dataset: Path, tmp_path: Path) -> None:
    config = tiny_config(dataset, iterations=1, optimizer=OptimizerConfig(sh_degree=3))
    few = replace(config, sparse=SparseConfig(below_views=5, sh_degree=1))
    many = replace(config, sparse=SparseConfig(below_views=4, sh_degree=1))
    assert train(few, tmp_path / "few").gaussians.sh_degree == 1
    assert train(many, tmp_path / "many").gaussians.sh_degree == 3


def test_the_compiled_backend_gives_the_same_bytes_for_any_number_of_threads(dataset: Path, tmp_path: Path) -> None:
    results = []
    for threads in (1, 3):
        run = tmp_path / str(threads)
        train(tiny_config(dataset, backend="cpu", threads=threads, iterations=60), run)
        results.append((run / "splat.ply").read_bytes())
    assert results[0] == results[1]


def test_the_first_difference_is_named_with_both_values() -> None:
    a, b = TrainConfig(), TrainConfig(threads=2, seed=4, optimizer=OptimizerConfig(beta1=0.8))
    assert first_difference(a.to_dict(), a.to_dict()) is None
    assert first_difference(a.to_dict(), replace(a, threads=2).to_dict()) is None
    assert first_difference(a.to_dict(), b.to_dict()) == "`optimizer.beta1` was 0.9, now 0.8"


def test_errors_have_the_exit_codes_that_the_help_promises() -> None:
    codes = [kind("x").exit_code for kind in (GsoptError, UsageError, InputError, NumericalError)]
    assert codes == [1, 2, 3, 4]


def test_the_speed_is_a_mean_of_recent_speeds_that_follows_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(loop.time, "perf_counter", lambda: now[0])
    clock = loop.Clock(40, 0.0, 0.0)
    found = []
    for step in (*range(60, 161, 20), *range(161, 181)):  # 10 steps a second at first, then half a step a second
        now[0] += 2
        found.append(clock.rate(step))
    assert found[:6] == pytest.approx([10.0] * 6)
    assert 0.5 < found[6] < 10
    assert found[6:] == sorted(found[6:], reverse=True)
    assert found[-1] == pytest.approx(0.5, rel=0.05)


def test_every_hundredth_step_checks_that_all_is_finite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Steps:
        """A run of 250 steps that does nothing else."""

        plan = SimpleNamespace(preview_every=0, checkpoint_every=0)
        step = 0

        @property
        def finished(self) -> bool:
            return self.step == 250

        def advance(self) -> tuple[float, str]:
            self.step += 1
            return 0.5, "a.png"

    checked: list[int] = []
    monkeypatch.setattr(loop, "_check_finite", lambda steps, directory: checked.append(steps.step))
    monkeypatch.setattr(loop, "_report_progress", lambda *_: None)
    directory: Any = SimpleNamespace(checkpoints=tmp_path)
    clock: Any = SimpleNamespace(is_due=lambda: False)
    assert not loop._advance(Steps(), directory, False, clock)  # type: ignore[arg-type]
    assert checked == [100, 200]


def test_every_repaired_mask_is_recorded_and_told() -> None:
    masks: Any = [SimpleNamespace(about=f"mask {i}", to_dict=lambda i=i: {"mask": i}) for i in range(2)]
    recorded: dict[str, Any] = {}
    told: list[str] = []
    directory: Any = SimpleNamespace(record=lambda **fields: recorded.update(fields), warn=told.append)
    loop._report_masks(masks, directory)
    assert recorded == {"repaired_masks": [{"mask": 0}, {"mask": 1}]}
    assert told == ["mask 0", "mask 1"]
