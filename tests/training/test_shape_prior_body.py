"""Runs on one to three photos whose other sides follow a shape prior."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import Ball, ring, write_balls
from PIL import Image
from tiny_scenes import tiny_config

from gsopt.config.guidance import GuidanceConfig, completes_bodies, shape_prior_of
from gsopt.config.train import InitConfig, SparseConfig, TrainConfig
from gsopt.errors import InputError, SettingError
from gsopt.events import read_events
from gsopt.results.report.shape_prior_section import shape_prior_section
from gsopt.sds.select_prior import select_prior
from gsopt.training.loop import TrainResult, train
from gsopt.training.reconstruct import reconstruct

sys.path.insert(0, str(Path(__file__).parents[1] / "shape_prior"))
from tiny_prior import untrained, write_prior

sys.path.pop(0)

pytestmark = pytest.mark.usefixtures("coarse_hull")

SPARSE = SparseConfig(steps_per_view=0, symmetry="off")
BALL = [Ball((0.0, 0.0, 0.0), 0.6, (200, 60, 30))]


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_prior(tmp_path_factory.mktemp("prior") / "small")


def photos(folder: Path, count: int) -> Path:
    """A ball, seen by cameras of a ring."""
    return write_balls(folder / "ball", BALL, ring(8, size=48)[slice(0, count)])


def config_of(dataset: Path, prior: Path, **changes: object) -> TrainConfig:
    config = tiny_config(dataset, iterations=12, init=InitConfig("auto", 600), sparse=SPARSE)
    guidance = GuidanceConfig(prior=f"shape:{prior}", prompt=("a red ball from a zoo",))
    return replace(config, guidance=guidance, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def result(prior: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    folder = tmp_path_factory.mktemp("run")
    return train(config_of(photos(folder, 1), prior), folder / "run")


def events_of(run: Path, kind: str) -> list[dict[str, object]]:
    return [event for event in read_events(run / "events.jsonl")[0] if event["kind"] == kind]


def test_the_body_is_what_the_run_learns_from_and_stands_in_its_record(result: TrainResult) -> None:
    scene = result.scene
    assert scene.body is not None
    assert scene.body_colors is not None
    assert scene.body_colors.shape == (*scene.body.occupied.shape, 3)
    points = scene.body.centers()
    assert float(points.norm(dim=1).quantile(0.9)) < 0.85
    assert len(scene.guessed) == 16
    record = json.loads((result.run / "config.json").read_text())["shape_prior"]
    assert (record["prior"], record["words"], record["photos"]) == ("small", ["ball"], 1)
    assert "zoo" in record["unknown_words"]
    assert "small" in str(events_of(result.run, "shape_prior")[0]["message"])
    pictures = sorted((result.run / "shape_prior").glob("side_*.png"))
    assert [path.name for path in pictures] == [f"side_{i:02d}.png" for i in range(4)]
    for path in pictures:
        with Image.open(path) as picture:
            assert picture.getpixel((0, 0)) == (255, 255, 255)
    assert "body of a shape prior" in str(events_of(result.run, "started")[0]["init"])


def test_the_same_photo_and_prior_give_the_same_bits(result: TrainResult, prior: Path, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    again = train(config_of(photos(tmp_path, 1), prior, threads=2), tmp_path / "run")
    torch.set_num_threads(threads)
    assert (again.run / "splat.ply").read_bytes() == (result.run / "splat.ply").read_bytes()
    other = write_prior(tmp_path / "other", untrained(1))
    (other / "weights_00.safetensors").write_bytes((prior / "weights_00.safetensors").read_bytes())
    assert train(config_of(tmp_path / "ball", other), tmp_path / "same").scene.body is not None


def test_unseen_sides_take_the_colors_of_the_prior(prior: Path, tmp_path: Path) -> None:
    painted = untrained()
    bias = painted.network.leave[-1].bias
    bias.view(4, 8)[3] += 2.0  # blue everywhere
    scene = train(config_of(photos(tmp_path, 1), write_prior(tmp_path / "blue", painted)), tmp_path / "run").scene
    middle = []
    for view in scene.guessed:
        solid = view.pixels()[view.pixels()[..., 3] > 250].float()
        middle.append(float(solid[:, 2].mean() - solid[:, 0].mean()))
    assert max(middle) > 20 > 0 > min(middle)


def test_two_photos_are_completed_and_four_are_left_alone(prior: Path, tmp_path: Path) -> None:
    two = train(config_of(photos(tmp_path / "two", 2), prior), tmp_path / "two" / "run")
    assert two.scene.body is not None
    assert two.scene.completed
    assert any("guess of a shape prior" in str(e["message"]) for e in events_of(two.run, "warning"))
    four = train(config_of(photos(tmp_path / "four", 4), prior), tmp_path / "four" / "run")
    assert four.scene.body is None
    assert four.scene.guessed == ()
    assert any("got 4 input views with masks" in str(e["message"]) for e in events_of(four.run, "warning"))


def test_the_report_shows_the_body_and_escapes_what_a_file_says(result: TrainResult, tmp_path: Path) -> None:
    messages: list[str] = []
    section = shape_prior_section(result.run, messages)
    assert section.count("<img") == 4
    assert "told: ball" in section
    assert "does not know" in section
    (tmp_path / "shape_prior").mkdir()
    bad = {"prior": "<script>", "words": ["<b>", 3], "unknown_words": 5, "digest": ["<i>"]}
    (tmp_path / "shape_prior" / "summary.json").write_text(json.dumps(bad))
    section = shape_prior_section(tmp_path, messages)
    assert not any(tag in section for tag in ("<script>", "<b>", "<i>"))
    assert messages == []
    (tmp_path / "shape_prior" / "summary.json").write_text("{")
    assert shape_prior_section(tmp_path, messages) == ""
    assert len(messages) == 1
    assert shape_prior_section(tmp_path / "elsewhere", messages) == ""


def test_a_prior_that_is_missing_is_an_error_before_any_work(tmp_path: Path) -> None:
    dataset = photos(tmp_path, 1)
    with pytest.raises(InputError, match="ships none"):
        reconstruct(dataset, tmp_path / "run", config=config_of(dataset, tmp_path / "none"))
    assert not (tmp_path / "run").exists()
    for name in ("shape", "shape:"):
        with pytest.raises(SettingError, match="shape:DIR"):
            GuidanceConfig(prior=name)


def test_another_prior_does_not_resume_a_run(result: TrainResult, prior: Path, tmp_path: Path) -> None:
    folder = write_prior(tmp_path / "prior")
    config = config_of(photos(tmp_path, 1), folder)
    train(config, tmp_path / "run")
    write_prior(folder, untrained(7))
    with pytest.raises(InputError, match="another shape prior"):
        train(config, tmp_path / "run", resume=True)


def test_a_shape_prior_loads_no_diffusion_model() -> None:
    choice = select_prior(GuidanceConfig(prior="shape:somewhere", prompt=("a chair",)))
    assert (choice.name, choice.weight) == (None, 0)
    assert (shape_prior_of("shape:a:b"), shape_prior_of("shapes:a"), shape_prior_of("library:a")) == ("a:b", None, None)
    assert [completes_bodies(name) for name in ("shape:a", "library", "embedded")] == [True, True, False]
