"""The web viewer at its limits: sizes in the browser, when colors are drawn again, and what a visitor is told."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from test_viewer import UP, Recorder, cameras, emit, gaussians, preview, recorder, run

from gsopt.formats import save_splats
from gsopt.formats.units import Units
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.results import viewer

__all__ = ["recorder", "run"]


@pytest.fixture
def shown(recorder: Recorder) -> viewer.SplatViewer:
    return viewer.SplatViewer("127.0.0.1", 0)


def colored(bands: int = 3) -> Gaussians:
    """Splats around the origin whose color depends on the eye."""
    random = torch.Generator().manual_seed(1)
    return replace(gaussians(), means=gaussians().means * 0.01, shN=torch.rand(5, bands, 3, generator=random))


@pytest.mark.parametrize("radius", [0.5, 4.0])
def test_drawn_cameras_are_as_large_for_the_eye_in_scenes_of_any_size(
    shown: viewer.SplatViewer, recorder: Recorder, radius: float
) -> None:
    """An eighth of the radius, with lines of a fiftieth of that; the photos are left out where there are none."""
    shown.show_cameras(cameras(), radius)
    for frustum in recorder.told("add_camera_frustum"):
        assert radius / 10 < frustum.scale < radius / 7
        assert frustum.thickness == pytest.approx(frustum.scale / 50)
        assert frustum.image is None
    shown.show_cameras(cameras(), radius, [0, 1, 2, 3])
    assert [frustum.image for frustum in recorder.told("add_camera_frustum")[4:]] == [0, 1, 2, 3]


def test_the_radius_holds_nine_of_ten_splats_around_their_median() -> None:
    line = torch.zeros(11, 3)
    line[8:, 0] = torch.tensor([2.0, 3.0, 100.0])
    center, radius = viewer.center_and_radius(line)
    assert (center.tolist(), radius) == ([0, 0, 0], 3.0)
    assert viewer.center_and_radius(line[:1]) == (pytest.approx(torch.zeros(3)), 1e-6)
    center, radius = viewer.center_and_radius(line[:0])
    assert (center.tolist(), radius) == ([0, 0, 0], 1.0)


def test_a_huge_splat_keeps_to_what_a_half_float_holds(shown: viewer.SplatViewer, recorder: Recorder) -> None:
    """Its variance of a million would be infinite there, and its covariance of the other sign too."""
    turn = torch.tensor([[math.cos(math.pi / 8), 0, 0, sign * math.sin(math.pi / 8)] for sign in (1, -1)])
    huge = replace(gaussians(2), quats=turn, log_scales=torch.tensor([[1e3, 1.0, 1.0]]).log().repeat(2, 1))
    shown.show_splats(huge, "huge")
    (splats,) = recorder.told("add_gaussian_splats")
    assert np.isfinite(splats.covariances.astype(np.float16)).all()
    assert splats.covariances.max() > 5e4
    assert splats.covariances.min() < -5e4


@pytest.mark.parametrize(("moved", "again"), [(0.29, False), (0.31, True)])
def test_colors_are_drawn_again_when_the_eye_moved_by_three_hundredths_of_its_distance(
    shown: viewer.SplatViewer, recorder: Recorder, moved: float, again: bool
) -> None:
    shown.look_from(torch.tensor([10.0, 0, 0]), torch.zeros(3))
    shown.show_splats(colored(), "caption")
    handle = recorder.server.scene.add_gaussian_splats.return_value
    handle.rgbs = "old"
    shown._follow_eye(SimpleNamespace(position=(10.0, moved, 0)))
    shown.refresh()
    assert (handle.rgbs is not None and not isinstance(handle.rgbs, str)) == again


def test_colors_that_no_eye_changes_are_not_drawn_again(shown: viewer.SplatViewer, recorder: Recorder) -> None:
    """Without splats, without harmonics, and with the slider at band 0 there is nothing to follow."""
    shown._follow_eye(SimpleNamespace(position=(5.0, 5, 5)))
    shown.refresh()
    handle = recorder.server.scene.add_gaussian_splats.return_value
    for model, degree in ((gaussians(), 3), (gaussians().select(torch.zeros(0, dtype=torch.int64)), 3), (colored(), 0)):
        shown.show_splats(model, "caption")
        shown.set_look(degree=degree)
        handle.rgbs = "old"
        shown._follow_eye(SimpleNamespace(position=(-90.0, 90, 90)))
        shown.refresh()
        assert handle.rgbs == "old"


def test_a_viewer_opens_with_whole_splats_all_bands_no_marks_and_hidden_cameras(
    shown: viewer.SplatViewer, recorder: Recorder
) -> None:
    gui = recorder.server.gui
    boxes = {call.args[0]: call.kwargs["initial_value"] for call in gui.add_checkbox.call_args_list}
    assert len(boxes) == 3
    assert not any(boxes.values())
    (frame,) = recorder.told("add_frame")
    assert (frame.visible, frame.show_axes) == (False, False)
    sliders = {call.args[0]: call.kwargs for call in gui.add_slider.call_args_list}
    assert sliders["splat size"] == {"min": 0.0, "max": 1.0, "step": 0.01, "initial_value": 1.0}
    assert sliders["SH degree"] == {"min": 0, "max": 3, "step": 1, "initial_value": 3}
    assert gui.add_rgb.call_args.kwargs["initial_value"] == (255, 255, 255)
    shown.set_background((10, 20, 30))
    (background,) = recorder.told("set_background_image")
    assert {tuple(pixel) for row in background.args[0].tolist() for pixel in row} == {(10, 20, 30)}


def test_every_control_of_the_panel_acts(recorder: Recorder) -> None:
    """Sliders and boxes change what is drawn, and a visitor who moves is followed."""
    handles: dict[str, MagicMock] = {}
    for kind in ("add_slider", "add_checkbox", "add_rgb"):
        getattr(recorder.server.gui, kind).side_effect = lambda name, **_: handles.setdefault(name, MagicMock())
    shown = viewer.SplatViewer("127.0.0.1", 0)
    shown.show_cameras(cameras()[:1], 1.0)
    shown.show_splats(colored(), "caption")
    splats, frame = (getattr(recorder.server.scene, name).return_value for name in ("add_gaussian_splats", "add_frame"))
    (before,) = recorder.told("add_gaussian_splats")

    def turn(name: str, value: object) -> None:
        handles[name].value = value
        handles[name].on_update.call_args.args[0](None)

    turn("splat size", 0.5)
    assert splats.covariances == pytest.approx(before.covariances / 4)
    turn("SH degree", 0)
    assert splats.rgbs != pytest.approx(before.rgbs)
    turn("SH degree", 3)
    assert splats.rgbs == pytest.approx(before.rgbs)
    shown._unseen = torch.ones(5, dtype=torch.bool)
    turn("mark what no photo shows", True)
    assert splats.rgbs != pytest.approx(before.rgbs)
    turn("background", (1, 2, 3))
    assert recorder.told("set_background_image")[0].args[0][0, 0].tolist() == [1, 2, 3]
    turn("input cameras and photos", True)
    assert frame.visible is True
    client = MagicMock()
    recorder.server.on_client_connect.call_args.args[0](client)
    client.camera.on_update.call_args.args[0](SimpleNamespace(position=(7.0, 8, 9)))
    assert shown._eye.tolist() == [7, 8, 9]


def test_a_file_is_seen_from_aside_in_its_own_units(
    shown: viewer.SplatViewer, recorder: Recorder, tmp_path: Path
) -> None:
    units = Units(0.25, (100.0, 0.0, -5.0))
    save_splats(tmp_path / "a.ply", gaussians(30), units=units)
    viewer.view_file(shown, tmp_path / "a.ply")
    assert (shown.measure.units, shown.keyframes.origin) == (units, units.origin)
    center, radius = viewer.center_and_radius(gaussians(30).means)
    eye = torch.tensor(recorder.server.initial_camera.position).float()
    torch.testing.assert_close((eye - center) / radius, torch.tensor([2.0, 2.0, 1.0]))
    torch.testing.assert_close(torch.tensor(recorder.server.initial_camera.look_at).float(), center)


@pytest.mark.parametrize("away", [False, True])
def test_the_opening_camera_turns_about_the_depth_of_the_splats(away: bool) -> None:
    """Or about a point one unit ahead where they lie behind it; splats that are not solid leave its lens as it is."""
    camera = cameras()[0]
    center = camera.centers[0] + (-7 if away else 2) * camera.forwards[0]
    model = replace(gaussians(), means=center.float().expand(5, 3).contiguous(), logit_opacities=torch.full((5,), -9.0))
    eye, target, up, fov = viewer.home_view(model, camera, center.float())
    ahead = camera.forwards[0].double()
    assert float((target - eye) @ ahead) == pytest.approx(1.0 if away else 2.0, rel=1e-5)
    torch.testing.assert_close(eye, camera.centers[0].double())
    assert float(up @ UP) > 0.9
    assert fov == pytest.approx(viewer.vertical_fov(camera))


def test_up_is_the_mean_as_long_as_the_cameras_do_not_nearly_cancel() -> None:
    """Of two that stand opposite but for a thousandth of a turn the mean is short, and still a direction."""
    for angle, known in ((0.01, True), (1e-4, False)):
        ups = [
            torch.tensor([math.sin(angle), math.cos(angle), 0.0]),
            torch.tensor([math.sin(angle), -math.cos(angle), 0]),
        ]
        views = []
        for up in ups:
            viewmat = torch.eye(4, dtype=torch.float64)
            viewmat[1, :3] = -up.double()
            views.append(Cameras(viewmat[None], torch.eye(3)[None], 4, 4))
        expected = [1.0, 0, 0] if known else [0, 0, 1.0]
        assert viewer.mean_up(views).tolist() == pytest.approx(expected, abs=1e-5)


def test_photos_in_the_browser_are_small() -> None:
    view: Any = SimpleNamespace(pixels=lambda: torch.full((200, 400, 3), 90, dtype=torch.uint8))
    found = viewer.photo(view)
    assert found.shape == (80, 160, 3)
    assert set(np.unique(found)) == {90}


def spoken(lines: list[str], once: bool, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    slept: list[float] = []
    monkeypatch.setattr(viewer.time, "sleep", slept.append)
    viewer.follow(iter(lines), once)
    return slept


def test_a_run_is_followed_until_nothing_is_new_or_for_good(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert spoken(["a", "b", "", "c"], True, monkeypatch) == []
    assert capsys.readouterr().out == "a\nb\n"
    slept = spoken(["a", "b", "", "c", ""], False, monkeypatch)
    assert capsys.readouterr().out == "a\nb\nc\n"
    assert len(slept) == 2
    assert all(0 < seconds <= 1 for seconds in slept)


class Stopped(Exception):
    """Ends a loop that serves without end."""


@pytest.mark.parametrize(("asked", "told"), [(0, False), (8080, False), (8079, True)])
def test_another_port_than_the_asked_one_is_told_and_the_server_stops_in_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, asked: int, told: bool
) -> None:
    server, made = MagicMock(port=8080), list[tuple[str, int]]()

    def opened(host: str, port: int) -> MagicMock:
        made.append((host, port))
        return server

    def seen(*_: object) -> None:
        raise Stopped

    monkeypatch.setattr(viewer, "SplatViewer", opened)
    monkeypatch.setattr(viewer, "view_file", seen)
    (tmp_path / "a.ply").touch()
    with pytest.raises(Stopped):
        viewer.serve(tmp_path / "a.ply", "localhost", asked, once=True)
    assert made == [("localhost", asked)]
    out = capsys.readouterr().out
    assert ("port 8079 is taken, using 8080" in out) == told
    assert "http://localhost:8080" in out
    server.stop.assert_called_once_with()


def test_a_file_is_served_until_interrupted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    server, slept = MagicMock(port=1), list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        if len(slept) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "SplatViewer", lambda *_: server)
    monkeypatch.setattr(viewer, "view_file", lambda *_: None)
    monkeypatch.setattr(viewer.time, "sleep", sleep)
    (tmp_path / "a.ply").touch()
    with pytest.raises(KeyboardInterrupt):
        viewer.serve(tmp_path / "a.ply", "localhost", 1, once=False)
    assert server.refresh.call_count == 3
    server.stop.assert_called_once_with()


def test_a_browser_keeps_its_view_when_the_next_preview_comes(
    run: Path, shown: viewer.SplatViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked, followed = list[object](), list[object]()
    monkeypatch.setattr(shown, "look_from", lambda *view: looked.append(view))
    monkeypatch.setattr(shown, "refresh", lambda: followed.append(None))
    (run / "units.json").write_text('{"meters_per_unit": 0.5}')
    lines: Iterator[str] = viewer.view_run(shown, run)
    for step in (1, 2, 3):
        emit(run, preview(run, step))
        assert next(lines) == f"step {step}"
        assert len(looked) == 1
        assert len(followed) == step
    assert shown.measure.units.meters_per_unit == 0.5
