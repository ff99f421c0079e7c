"""The loop around the trainer, with stand-ins for its parts: what happens in which order, and what is recorded."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud, tiny_config

from gsopt.config.cells import CellConfig
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import SparseConfig
from gsopt.data.scene import Scene, load_scene, read_ahead
from gsopt.errors import InputError, NumericalError
from gsopt.formats import load_splats
from gsopt.formats.ply import save_ply
from gsopt.raster.api import make_backend
from gsopt.training import loop
from gsopt.training.checkpoint import newest_saved
from gsopt.training.plan import RunPlan
from gsopt.training.run_directory import RunDirectory, opened


class Steps:
    """A trainer that only counts, and tells its steps."""

    def __init__(self, last: int, told: list[str], step: int = 0, preview: int = 0, checkpoint: int = 0) -> None:
        self.plan = SimpleNamespace(preview_every=preview, checkpoint_every=checkpoint)
        self.step, self.last, self.told = step, last, told

    @property
    def finished(self) -> bool:
        return self.step >= self.last

    def advance(self) -> tuple[float, str]:
        self.step += 1
        self.told.append(f"step {self.step}")
        return 0.5, "a.png"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[bool, list[str]]]:
    """Runs some steps; returns whether they were stopped, and what happened in order."""

    def advanced(last: int, stop_at: int = 99, due: bool = False, **counts: int) -> tuple[bool, list[str]]:
        told: list[str] = []
        steps = Steps(last, told, **counts)
        for name in ("_preview", "_save", "_report_progress"):
            monkeypatch.setattr(loop, name, lambda *_, name=name: told.append(name))
        directory: Any = SimpleNamespace(checkpoints=tmp_path, previews=tmp_path / "previews")
        stop = type("Stop", (), {"__bool__": lambda self: steps.step >= stop_at})()
        clock: Any = SimpleNamespace(is_due=lambda: due)
        return loop._advance(steps, directory, stop, clock), told  # type: ignore[arg-type]

    return advanced


def test_a_preview_comes_before_the_checkpoint_of_its_step_and_progress_at_the_end(run: Any) -> None:
    stopped, told = run(4, preview=2, checkpoint=2)
    assert not stopped
    two = ["_preview", "_save"]
    assert told == ["step 1", "step 2", *two, "step 3", "step 4", "_preview", "_report_progress", "_save"]
    assert run(2, due=True)[1] == ["step 1", "_report_progress", "step 2", "_report_progress"]


def test_a_run_stops_after_the_step_in_which_it_was_asked(run: Any) -> None:
    assert run(5, stop_at=2) == (True, ["step 1", "step 2"])
    assert run(2, stop_at=2) == (False, ["step 1", "step 2", "_report_progress"])
    assert run(2, stop_at=0) == (True, [])


@pytest.mark.parametrize(
    ("step", "every", "there", "again"),
    [(4, 2, False, True), (4, 2, True, False), (4, 3, False, False), (0, 2, False, False)],
)
def test_a_preview_that_a_disk_refused_is_made_up_for(
    run: Any, tmp_path: Path, step: int, every: int, there: bool, again: bool
) -> None:
    if there:
        (tmp_path / "previews").mkdir()
        (tmp_path / "previews" / f"step_{step:06d}.ply").touch()
    assert run(step, step=step, preview=every)[1] == (["_preview"] if again else [])


@pytest.mark.parametrize("refused", ["_preview", "_report_progress"])
def test_the_steps_are_kept_where_the_disk_refuses_what_is_told(
    run: Any, refused: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise InputError("full")

    told: list[str] = []
    steps: Any = Steps(3, told, preview=3)
    run(1)
    monkeypatch.setattr(loop, refused, full)
    monkeypatch.setattr(loop, "_save", lambda *_: told.append("_save"))
    directory: Any = SimpleNamespace(checkpoints=Path("none"), previews=Path("none"))
    with pytest.raises(InputError, match="full"):
        loop._advance(steps, directory, False, SimpleNamespace(is_due=lambda: False))  # type: ignore[arg-type]
    assert told == ["step 1", "step 2", "step 3", "_save"]


@pytest.fixture(scope="module")
def scene(dataset: Path) -> Scene:
    return load_scene(str(dataset))


def started(folder: Path, scene: Scene, resume: bool = False, **changes: Any) -> tuple[Any, list[dict[str, Any]]]:
    """A trainer at its first step, or at that of its checkpoint, and the events of its start."""
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0))
    told: list[dict[str, Any]] = []
    with opened(folder, config, resume, lambda event: told.append(dict(event))) as directory:
        plan = replace(RunPlan.of(config, scene), **changes)
        found = loop._start(plan, scene, make_backend("cpu", 1), directory, None, 0.0)
        if not resume:
            loop._save(found[0], directory, found[1])
    return found, told


def stand_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """No time passes."""
    monkeypatch.setattr(loop.time, "perf_counter", lambda: 4096.0)
    monkeypatch.setattr(loop.time, "process_time", lambda: 2048.0)


@torch.no_grad()
def test_a_start_records_what_the_report_needs(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_still(monkeypatch)
    images = tuple(replace(view, mirrored=i < 10) for i, view in enumerate(scene.train * 4))
    given = replace(scene, mirrored=images, origin=(1.0, 2.0, 3.0))
    (trainer, clock), told = started(tmp_path, given)
    event = next(event for event in told if event["kind"] == "started")
    assert (event["step"], event["total"], event["train_views"], event["test_views"]) == (0, 30, 5, 2)
    assert (event["mirrors"], event["turns"], event["guessed"]) == (2, 2, 0)
    assert (event["backend"], event["n"]) == ("cpu", len(trainer.model))
    document = json.loads((tmp_path / "config.json").read_text())
    assert document["origin"] == [1.0, 2.0, 3.0]
    assert document["train_views"] == [view.name for view in scene.train]
    assert event["init"] == document["gaussians_init"]
    assert clock.spent() == {"seconds": 0.0, "cpu_seconds": 0.0}


@torch.no_grad()
def test_a_resumed_start_goes_on_in_step_and_time_and_refuses_other_views(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_still(monkeypatch)
    (trainer, _), _ = started(tmp_path, scene)
    for _ in range(3):
        trainer.advance()
    directory: Any = SimpleNamespace(checkpoints=tmp_path / "checkpoints", warn=print)
    loop._save(trainer, directory, SimpleNamespace(spent=lambda: {"seconds": 1000.0, "cpu_seconds": 500.0}))  # type: ignore[arg-type]
    (again, clock), told = started(tmp_path, scene, resume=True)
    assert again.step == 3
    assert next(event for event in told if event["kind"] == "started")["step"] == 3
    assert torch.equal(again.model.gaussians.means, trainer.model.gaussians.means)
    assert clock.spent() == {"seconds": 1000.0, "cpu_seconds": 500.0}
    with pytest.raises(InputError, match="other views than when the run began"):
        started(tmp_path, replace(scene, train=scene.train[:4]), resume=True)


@torch.no_grad()
def test_a_cell_starts_from_its_splats(scene: Scene, tmp_path: Path) -> None:
    save_ply(tmp_path / "start.ply", cloud(33, seed=4))
    (trainer, _), told = started(tmp_path / "run", scene, cell=CellConfig(start=str(tmp_path / "start.ply")))
    assert len(trainer.model) == 33
    assert told[0]["init"] == f"splats of {tmp_path / 'start.ply'}"


def test_warnings_of_the_scene_and_of_few_photos_are_told(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "few_photo_warnings", lambda scene: ("few",))
    _, told = started(tmp_path, replace(scene, warnings=("dark",)))
    assert [event["message"] for event in told if event["kind"] == "warning"] == ["dark", "few"]


@torch.no_grad()
def test_a_preview_is_on_the_disk_before_it_is_told(scene: Scene, tmp_path: Path) -> None:
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0))
    seen: list[tuple[str, int]] = []

    def hear(event: Any) -> None:
        if event["kind"] == "preview":
            seen.append((event["path"], len(load_splats(tmp_path / event["path"]))))

    with opened(tmp_path, config, False, hear) as directory:
        trainer, _ = loop._start(RunPlan.of(config, scene), scene, make_backend("cpu", 1), directory, None, 0.0)
        trainer.step = 12
        loop._preview(trainer, directory)
        assert seen == [("previews/step_000012.ply", len(trainer.model))]
        trainer.model.gaussians.means[0, 0] = math.nan
        for write in (loop._preview, lambda *args: loop._save(*args, loop.Clock(0, 0.0, 0.0))):
            with pytest.raises(NumericalError, match="`means` became nan"):
                write(trainer, directory)
    assert len(seen) == 1


@torch.no_grad()
def test_the_end_of_a_run_writes_its_splats_poses_and_exposures(scene: Scene, tmp_path: Path) -> None:
    """And a checkpoint before them."""

    def record(name: str) -> Any:
        return SimpleNamespace(record=lambda *origin: {"name": name, "origin": [*origin]})

    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0))
    for poses, exposure in ((None, None), (record("poses"), None), (None, record("exposure"))):
        folder = tmp_path / f"{poses is None}-{exposure is None}"
        with opened(folder, config, False, None) as directory:
            trainer, clock = loop._start(RunPlan.of(config, scene), scene, make_backend("cpu", 1), directory, None, 0.0)
            state = trainer.state()
            trainer.state = lambda state=state: state  # type: ignore[method-assign]
            trainer.poses, trainer.exposure = poses, exposure
            loop._finish(trainer, directory, clock)
        assert len(load_splats(folder / "splat.ply")) == len(trainer.model)
        assert [path.name for path in (folder / "checkpoints").iterdir()] == ["step_000000.safetensors"]
        assert (folder / "poses.json").is_file() == (poses is not None)
        assert (folder / "exposure.json").is_file() == (exposure is not None)


def test_the_newest_checkpoint_is_the_last_good_state(tmp_path: Path) -> None:
    assert newest_saved(tmp_path) is None
    for step in (10, 30, 20):
        (tmp_path / f"step_{step:06d}.safetensors").touch()
    assert newest_saved(tmp_path) == tmp_path / "step_000030.safetensors"


def test_held_out_images_are_read_before_the_work() -> None:
    def broken() -> None:
        raise InputError("b.png cannot be decoded")

    read: list[str] = []
    views: Any = [SimpleNamespace(pixels=lambda: read.append("a")), SimpleNamespace(pixels=broken)]
    with pytest.raises(InputError, match=r"b\.png"):
        read_ahead(views)
    assert read == ["a"]


def test_a_directory_records_and_recalls_beside_the_settings(tmp_path: Path) -> None:
    config = tiny_config(Path("unused"))
    heard: list[str] = []
    with opened(tmp_path, config, False, lambda event: heard.append(event["kind"])) as directory:
        assert isinstance(directory, RunDirectory)
        assert directory.recorded("estimate") is None
        directory.record(estimate=3)
        directory.record(other=[4])
        assert (directory.recorded("estimate"), directory.recorded("other")) == (3, [4])
        directory.warn("careful")
    assert heard == ["warning"]
    document = json.loads((tmp_path / "config.json").read_text())
    assert document["config"] == json.loads(json.dumps(config.to_dict()))
    assert {"torch", "numpy", "pillow", "safetensors", "gsopt", "python", "platform"} == set(document["versions"])


def test_a_request_to_stop_of_an_earlier_run_is_taken_back(tmp_path: Path) -> None:
    tmp_path.joinpath("stop").touch()
    with opened(tmp_path, tiny_config(Path("unused")), False, None) as directory:
        assert not directory.stop_file.exists()
        assert directory.previews.is_dir()
        assert directory.checkpoints.is_dir()


def test_what_is_left_of_a_slow_run_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {}
    schedule = SimpleNamespace(iterations=100)
    steps: Any = SimpleNamespace(
        means=SimpleNamespace(loss=0.25, psnr=None), step=40, model=[], plan=SimpleNamespace(schedule=schedule)
    )
    directory: Any = SimpleNamespace(emit=lambda kind, **fields: told.update(fields))
    clock: Any = SimpleNamespace(rate=lambda step: 0.5, seconds=lambda: 0.0, cpu_seconds=lambda: 0.0)
    loop._report_progress(steps, directory, clock)
    assert told["eta_seconds"] == 120.0


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("limit", [None, 99])
def test_memory_and_time_are_estimated_on_the_cpu(
    guided: bool, limit: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No time with guidance, whose networks nobody has measured; a limit is asked for where there is one."""
    asked: list[int] = []
    expected = SimpleNamespace(memory=1_234_567_890, seconds=77.6, require=asked.append)
    monkeypatch.setattr(loop, "estimate", lambda config, plan, scene, frozen: (asked.append(frozen), expected)[1])
    monkeypatch.setattr(loop, "memory_limit", lambda config: limit)
    nothing: Any = None
    backend: Any = SimpleNamespace(name="cpu")
    found = loop.require_memory(nothing, nothing, nothing, backend, object() if guided else None)  # type: ignore[arg-type]
    assert found == {"memory_mb": 1235, **({} if guided else {"cpu_seconds": 78})}
    assert asked == [0] + [99] * (limit is not None)


class Ended(Exception):
    """Ends a run before its first step."""


@pytest.mark.parametrize(
    ("photos", "asks", "mirrored", "parts"),
    [
        (1, False, False, ["body", "guesses"]),
        (2, True, False, ["body", "guesses"]),
        (2, False, False, ["guesses"]),
        (1, False, True, ["body"]),
    ],
)
def test_a_single_photo_or_one_who_asks_gets_a_body_and_what_has_no_mirrors_gets_guesses(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, photos: int, asks: bool, mirrored: bool, parts: Any
) -> None:
    whole, done = load_scene(str(dataset)), list[str]()
    scene = replace(whole, train=whole.train[:photos], mirrored=whole.train[3:] if mirrored else ())
    guidance = GuidanceConfig(lambda_sds=0.0) if asks else GuidanceConfig()

    def ends(*_: object) -> bool:
        raise Ended

    read: list[Any] = []
    monkeypatch.setattr(loop, "read_ahead", read.append)
    monkeypatch.setattr(loop, "load_with_agreeing_masks", lambda data: (scene, []))
    monkeypatch.setattr(loop, "with_recorded_mirrors", lambda config, scene, directory: scene)
    monkeypatch.setattr(loop, "_with_prior_body", lambda config, scene, *_: (done.append("body"), scene)[1])
    monkeypatch.setattr(loop, "with_guessed_views", lambda scene, backend: (done.append("guesses"), scene)[1])
    monkeypatch.setattr(loop, "matches_photos", ends)
    with pytest.raises(Ended):
        loop.train(tiny_config(dataset, guidance=guidance), tmp_path / "run")
    assert done == parts
    assert read == [scene.test], "held-out images are read before anything that takes time"
