"""`gsopt.reconstruct`: the call behind `gsopt train`, with the same files, bits and refusals."""

from __future__ import annotations

import importlib
import json
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from run_configs import HANGUP
from tiny_scenes import write_dataset

import gsopt
from gsopt import cli
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.errors import GsoptError, InputError, MissingDependency, SettingError, UsageError
from gsopt.events import read_events
from gsopt.results.evaluation import read_metrics
from gsopt.training.reconstruct import _absolute

SHORT: dict[str, Any] = {
    "iterations": 4,
    "init": {"method": "random", "count": 20},
    "guidance": {"lambda_sds": 0.0},
    "sparse": {"symmetry": "off"},
}
FLAGS = "--iterations 4 --init random --init-count 20 --lambda_sds 0 --views 2 --sparse.symmetry off"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "scene")
    return tmp_path / "scene"


def test_python_and_the_command_line_write_the_same_run(data: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    events: list[str] = []
    result = gsopt.reconstruct(
        DataConfig(str(data), views=2),
        tmp_path / "python",
        on_progress=lambda event: events.append(event["kind"]),
        log=lines.append,
        **SHORT,
    )
    assert cli.main(["train", str(data), "-m", str(tmp_path / "flags"), *FLAGS.split()]) == 0
    for name in ("config.json", "splat.ply"):
        assert (tmp_path / "python" / name).read_bytes() == (tmp_path / "flags" / name).read_bytes()
    assert result.metrics == json.loads((result.run / "metrics.json").read_bytes())
    assert result.report == tmp_path / "python" / "report.html"
    assert len(result.gaussians) == len(gsopt.load_splats(result.run / "splat.ply"))
    assert (events[0], events[-1], events.count("done")) == ("started", "done", 1)
    assert any("evaluating" in line for line in lines)


def test_clean_leaves_out_what_no_input_view_needs_before_the_run_is_evaluated(data: Path, tmp_path: Path) -> None:
    """Random Gaussians, most of them outside of every view; the plain run has them all."""
    lines: list[str] = []
    settings = SHORT | {"init": {"method": "random", "count": 400}}
    plain = gsopt.reconstruct(str(data), tmp_path / "plain", **settings)
    for resume in (False, True):  # the second time from the last checkpoint, which has all splats
        arguments: dict[str, Any] = {"resume": True} if resume else settings | {"clean": True}
        result = gsopt.reconstruct(None if resume else str(data), tmp_path / "run", log=lines.append, **arguments)
        assert result.metrics is not None
        left = result.metrics["n_gaussians"]
        assert left == len(result.gaussians) == len(gsopt.load_splats(result.run / "splat.ply"))
        assert 0 < left < len(plain.gaussians)
        assert f"cleaned: {len(plain.gaussians) - left:,} of {len(plain.gaussians):,} splats go" in lines[-2]
    assert (tmp_path / "run/splat.before-clean.ply").read_bytes() == (tmp_path / "plain/splat.ply").read_bytes()


@pytest.mark.parametrize(
    ("masks", "sought", "left"),
    [("given", "auto", "given"), ("none", "none", "none"), ("DIR", "DIR", "given")],
)
def test_features_and_masks_reach_the_search_for_poses(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, masks: str, sought: str, left: str
) -> None:
    photos, folder = tmp_path / "photos", tmp_path / "silhouettes"
    photos.mkdir()
    folder.mkdir()
    Image.new("RGB", (200, 200)).save(photos / "one.jpg")
    asked: list[Any] = []

    def scene_beside(source: Path, _folder: Path, config: Any, _log: Any) -> Path:
        asked.append((source, config))
        return data

    monkeypatch.setattr("gsopt.training.reconstruct.posed_scene", scene_beside)
    flags = ["--masks", masks.replace("DIR", str(folder)), "--features", "both", "--seed", "3"]
    assert cli.main(["train", str(photos), "-m", str(tmp_path / "run"), *FLAGS.split(), *flags]) == 0
    ((source, config),) = asked
    assert (source, config.masks) == (photos, sought.replace("DIR", str(folder)))
    assert (config.features, config.seed) == ("both", 3)
    recorded = TrainConfig.read(tmp_path / "run" / "config.json").data
    assert (recorded.path, recorded.masks) == (str(data), left)


def test_features_for_a_dataset_with_poses_are_said_to_change_nothing(data: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    gsopt.reconstruct(DataConfig(str(data), views=2, features="xfeat"), tmp_path / "run", log=lines.append, **SHORT)
    assert f"{data} has poses: `--features xfeat` changes nothing" in lines


def test_a_missing_mask_model_is_told_before_poses_are_sought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    monkeypatch.delenv("GSOPT_MASK_MODEL", raising=False)
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "b.jpg"):
        Image.new("RGB", (32, 32), (200, 40, 90)).save(photos / name)
    with pytest.raises(MissingDependency, match="mask model"):
        gsopt.reconstruct(DataConfig(str(photos), masks="auto"), tmp_path / "run", **SHORT)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]
    (photos / "masks").mkdir()
    with pytest.raises(GsoptError) as raised:  # masks that may serve: the poses come first, and cannot be had
        gsopt.reconstruct(DataConfig(str(photos), masks="auto"), tmp_path / "run", **SHORT)
    assert not isinstance(raised.value, MissingDependency)


def test_a_finished_run_is_refused_and_resumed_from_its_folder_alone(data: Path, tmp_path: Path) -> None:
    first = gsopt.reconstruct(data, tmp_path / "run", **SHORT)
    with pytest.raises(UsageError, match="holds another run"):
        gsopt.reconstruct(data, tmp_path / "run", **SHORT)
    again = gsopt.reconstruct(None, tmp_path / "run", resume=True)
    assert again.metrics is not None
    assert first.metrics is not None
    assert again.metrics["mean"] == first.metrics["mean"]


def test_the_folder_of_another_run_is_refused_before_poses_are_sought(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sought: list[Path] = []
    monkeypatch.setattr("gsopt.training.reconstruct.posed_scene", lambda source, *_: sought.append(source) or data)
    (tmp_path / "photos").mkdir()
    Image.new("RGB", (200, 200)).save(tmp_path / "photos" / "one.jpg")
    gsopt.reconstruct(tmp_path / "photos", tmp_path / "first", **SHORT)
    assert sought == [tmp_path / "photos"]
    (tmp_path / "run").mkdir()
    shutil.copy(tmp_path / "first" / "splat.ply", tmp_path / "run")
    with pytest.raises(UsageError, match="holds another run"):
        gsopt.reconstruct(tmp_path / "photos", tmp_path / "run", **SHORT)
    assert len(sought) == 1
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["splat.ply"]


@pytest.mark.parametrize(
    ("settings", "error", "text"),
    [
        ({"iterations": 0}, SettingError, "`iterations` must be at least 1, got 0"),
        ({"iteratoins": 5}, InputError, "config.iteratoins"),
        ({"seed": "1"}, InputError, "config.seed"),
        ({"preset": "best"}, SettingError, "`preset` must be one of draft, default, high"),
        ({"guidance": {"prompt": ["a \x1b chair"]}}, InputError, "control character"),
        ({"guidance": {"prompts": "absent.json"}}, InputError, "absent.json"),
        ({"config": TrainConfig(), "seed": 1}, UsageError, "Keep one"),
    ],
)
def test_a_wrong_setting_or_prompt_is_refused_before_any_work(settings, error, text: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=text):
        gsopt.reconstruct(tmp_path / "absent", tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_weights_that_are_not_there_are_noticed_before_any_work(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSOPT_LPIPS_VGG", str(tmp_path / "absent.npz"))
    with pytest.raises(InputError, match=r"absent\.npz"):
        gsopt.reconstruct(data, tmp_path / "run", vgg=True, **SHORT)
    assert not (tmp_path / "run").exists()
    assert gsopt.reconstruct(data, tmp_path / "run", **SHORT).metrics is not None  # nobody asks for it here


def test_a_held_out_image_that_cannot_be_read_ends_the_run_before_its_first_step(data: Path, tmp_path: Path) -> None:
    shutil.copytree(data, tmp_path / "data")
    image = next((tmp_path / "data" / "test").glob("*.png"))
    image.write_bytes(image.read_bytes()[:-40])
    with pytest.raises(InputError, match=image.name):
        gsopt.reconstruct(tmp_path / "data", tmp_path / "run", **SHORT)
    kinds = {event["kind"] for event in read_events(tmp_path / "run" / "events.jsonl")[0]}
    assert "started" not in kinds


def test_events_count_the_views_that_were_evaluated(data: Path, tmp_path: Path) -> None:
    gsopt.reconstruct(data, tmp_path / "run", **SHORT)
    events = read_events(tmp_path / "run" / "events.jsonl")[0]
    last = [event for event in events if event["kind"] == "evaluation"][-1]
    assert last["views"] == last["total"] == len(read_metrics(tmp_path / "run")["per_view"])


@pytest.mark.parametrize("number", [signal.SIGTERM, HANGUP, signal.SIGINT])
@pytest.mark.parametrize("moment", ["gsopt.training.reconstruct.evaluate", "gsopt.training.loop._finish"])
def test_a_run_that_is_stopped_while_it_is_evaluated_ends_as_stopped_and_resumes(
    moment: str, number: signal.Signals, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, name = moment.rsplit(".", 1)
    original = getattr(importlib.import_module(module), name)

    def signalled(*args, **kwargs):
        signal.raise_signal(number)
        return original(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(moment, signalled)
        stopped = gsopt.reconstruct(data, tmp_path / "run", **SHORT)
    assert (stopped.metrics, stopped.report) == (None, None)
    assert read_events(tmp_path / "run" / "events.jsonl")[0][-1]["kind"] == "stopped"
    again = gsopt.reconstruct(None, tmp_path / "run", resume=True)
    assert again.metrics is not None
    assert read_events(tmp_path / "run" / "events.jsonl")[0][-1]["kind"] == "done"


def test_a_missing_dataset_is_an_error_of_gsopt(tmp_path: Path) -> None:
    for data, resume in ((None, False), (None, True), (tmp_path / "absent", False)):
        with pytest.raises(GsoptError):
            gsopt.reconstruct(data, tmp_path / "run", resume=resume)


def test_what_exists_becomes_absolute_and_no_name_stays_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path)
    names = ("", "here", "library:here", "shape:here", "sd21", "library")
    here = str(tmp_path / "here")
    assert [_absolute(name) for name in names] == [
        "", here, f"library:{here}", f"shape:{here}", "sd21", "library",
    ]  # fmt: skip
