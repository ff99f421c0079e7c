"""How a report is read from a run, with stand-ins for renders: what is chosen, named, counted and left out."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image

from gsopt.config.train import TrainConfig
from gsopt.results.report.read_run import Report

reading = importlib.import_module("gsopt.results.report.read_run")  # the package has its function under this name


def report(**fields: Any) -> Report:
    return Report("scene", TrainConfig(), {}, fields.pop("metrics", {}), [], [], **fields)


@pytest.mark.parametrize(
    ("event", "told"),
    [
        ({"kind": "warning", "message": "dark"}, "dark"),
        ({"kind": "error", "message": "full"}, "The run ended with an error: full"),
        ({"kind": "error"}, "The run ended with an error: "),
        ({"kind": "done", "message": "x"}, None),
        ({}, None),
    ],
)
def test_warnings_and_errors_are_told_and_nothing_else(event: dict[str, Any], told: str | None) -> None:
    assert reading._message(event) == told


def test_figures_are_those_of_held_out_views_or_else_of_training_views() -> None:
    mean, row = {"psnr": 30.5, "ssim": "x", "other": 1}, {"name": "a", "psnr": 31, "ssim": True}
    held_out = report(
        metrics={"mean": mean, "per_view": [row, 7], "n_gaussians": 9.0, "steps": 30, "train": {"mean": {}}}
    )
    reading._add_figures(held_out)
    assert held_out.held_out
    assert (held_out.mean["psnr"], held_out.mean["ssim"]) == (30.5, None)
    assert "other" not in held_out.mean
    assert [one["name"] for one in held_out.per_view] == ["a"]
    assert (held_out.per_view[0]["psnr"], held_out.per_view[0]["ssim"]) == (31, None)
    assert (held_out.n_gaussians, held_out.steps) == (9, 30)
    training = report(metrics={"mean": None, "train": {"mean": mean, "per_view": [row]}})
    reading._add_figures(training)
    assert not training.held_out
    assert training.mean["psnr"] == 30.5
    assert len(training.per_view) == 1
    assert (training.n_gaussians, training.steps) == (None, None)
    nothing = report()
    reading._add_figures(nothing)
    assert (nothing.held_out, nothing.mean, nothing.per_view) == (True, {}, [])


def shown(
    rows: list[tuple[str, float | None]], held_out: bool, monkeypatch: pytest.MonkeyPatch, viewer: str = "v"
) -> Report:
    """The evaluated views of a report on a scene whose views a, b, c are held out and d, e are input views."""
    monkeypatch.setattr(reading, "_evaluated_view", lambda run, view, row, badge: (view.name, row["psnr"], badge))
    monkeypatch.setattr(reading, "_viewer", lambda run, scene: viewer)
    monkeypatch.setattr(reading, "_add_turntable", lambda report, run, scene: report.turntable.append("turned"))
    found = report(held_out=held_out, per_view=[{"name": name, "psnr": psnr} for name, psnr in rows])
    scene: Any = SimpleNamespace(
        test=[SimpleNamespace(name=name) for name in "abc"], train=[SimpleNamespace(name=name) for name in "de"]
    )
    run: Any = SimpleNamespace(gaussians=[1] * 5, backend=SimpleNamespace(name="cpu"))
    reading._add_renders(found, run, scene)
    return found


def test_views_go_from_the_worst_to_the_best_and_one_alone_is_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that the dataset no longer has, or whose figures are broken, are left out."""
    rows = [("a", 30.0), ("gone", 1.0), ("b", 20.0), ("c", 25.0), ("d", 9.0)]
    found = shown(rows, True, monkeypatch)
    assert found.evaluated == [("b", 20.0, "worst"), ("c", 25.0, ""), ("a", 30.0, "best")]
    assert (found.n_gaussians, found.backend, found.turntable) == (5, "cpu", [])
    assert shown([("a", 30.0), ("b", None)], True, monkeypatch).evaluated == [("a", 30.0, "")]
    assert shown(rows, False, monkeypatch).evaluated == [("d", 9.0, "")]
    assert shown([], True, monkeypatch, viewer="").turntable == ["turned"]


@pytest.mark.parametrize(("size", "viewer"), [(6 << 20, "element"), ((6 << 20) + 1, "")])
def test_a_report_holds_six_megabytes_of_splats(size: int, viewer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(reading, "packed_splats", lambda splats, path: SimpleNamespace(data=range(size), path=path))
    monkeypatch.setattr(reading, "scene_of_views", lambda run, scene: "scene")
    monkeypatch.setattr(
        reading, "viewer_element", lambda scene, payload, opened: (asked.append((scene, opened)), "element")[1]
    )
    run: Any = SimpleNamespace(gaussians=None, path=Path("run"))
    assert reading._viewer(run, None) == viewer  # type: ignore[arg-type]
    assert asked == [("scene", False)] * bool(viewer)


@pytest.mark.parametrize(("side", "longest"), [(100, 200), (199, 398), (200, 400), (800, 400)])
def test_a_turntable_is_no_larger_than_400_pixels_or_twice_the_photos(
    side: int, longest: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(reading.Cameras, "of_one_size", staticmethod(lambda cameras: cameras))
    monkeypatch.setattr(
        reading, "camera_path", lambda run, cameras, path, count: (asked.append((path, count)), [1, 2])[1]
    )
    monkeypatch.setattr(reading, "with_longest_side", lambda camera, side: (camera, side))
    monkeypatch.setattr(reading, "as_image", lambda drawn: drawn)
    camera = SimpleNamespace(width=side, height=side // 2)
    scene: Any = SimpleNamespace(train=[SimpleNamespace(camera=camera)])
    found, run = report(), SimpleNamespace(draw=lambda shot: shot)
    reading._add_turntable(found, run, scene)  # type: ignore[arg-type]
    assert found.turntable == [(1, longest), (2, longest)]
    assert asked == [("turntable", 36)]


def test_up_to_24_input_views_are_shown_small(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = torch.zeros(300, 600, 3, dtype=torch.uint8)
    views = [SimpleNamespace(name=f"{i}", pixels=lambda: pixels) for i in range(48)]
    scene: Any = SimpleNamespace(train=views, test=[None] * 3)
    found = report()
    reading._add_inputs(found, scene)
    assert [name for name, _ in found.inputs] == [f"{2 * i}" for i in range(24)]
    assert {image.size for _, image in found.inputs} == {(200, 100)}
    assert (found.input_count, found.test_count) == (48, 3)
    assert isinstance(found.inputs[0][1], Image.Image)


def test_a_file_that_is_no_object_counts_as_none_and_a_broken_one_is_named(tmp_path: Path) -> None:
    messages: list[str] = []
    path = tmp_path / "metrics.json"
    assert reading._read_object(path, messages) == {}
    path.write_text("[1]")
    assert reading._read_object(path, messages) == {}
    path.write_text('{"a": 1}')
    assert reading._read_object(path, messages) == {"a": 1}
    assert messages == []
    path.write_text("{")
    assert reading._read_object(path, messages) == {}
    assert len(messages) == 1
    assert messages[0].startswith("metrics.json cannot be read")
