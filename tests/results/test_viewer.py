"""The web viewer: it follows a run, places the cameras, and starts a real server."""

from __future__ import annotations

import itertools
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from finished_runs import make_run, splats
from PIL import Image

from gsopt import cli
from gsopt.config.train import DataConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, MissingDependency
from gsopt.events import EventWriter, to_json
from gsopt.formats import save_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats
from gsopt.geometry.quats import rotation_matrices
from gsopt.results import run_follower, viewer, viewer_controls

SIZE = 16
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
EYES = torch.tensor([[3.0, 0, 1], [0, 3, 1], [-3, 0, 1], [0, -3, 1]], dtype=torch.float64)


def gaussians(n: int = 5, seed: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=random),
        quats=torch.randn(n, 4, generator=random),
        log_scales=torch.randn(n, 3, generator=random) - 2,
        logit_opacities=torch.randn(n, generator=random),
        sh0=torch.randn(n, 1, 3, generator=random),
        shN=torch.zeros(n, 0, 3),
    )


def cameras() -> list[Cameras]:
    viewmats = look_at(EYES, torch.zeros(3, dtype=torch.float64), UP)
    K = intrinsics(0.8, 2 * SIZE, SIZE)
    return [Cameras(viewmat[None], K[None], 2 * SIZE, SIZE) for viewmat in viewmats]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run directory with a config that names a dataset of four views, and no events yet."""
    dataset, folder = tmp_path / "scene", tmp_path / "run"
    (dataset / "train").mkdir(parents=True)
    (folder / "previews").mkdir(parents=True)
    frames = []
    for i, camera in enumerate(cameras()):
        Image.new("RGBA", (2 * SIZE, SIZE), (200, 100, 50, 255)).save(dataset / f"train/r_{i}.png")
        pose = opengl_from_viewmats(camera.viewmats[0]).tolist()
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": pose})
    (dataset / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    config = TrainConfig(data=DataConfig(path=str(dataset)))
    (folder / "config.json").write_bytes(to_json({"config": config.to_dict()}))
    return folder


def emit(run: Path, *events: dict[str, Any]) -> None:
    writer = EventWriter(run)
    for event in events:
        writer.emit(**event)
    writer.close()


def preview(run: Path, step: int) -> dict[str, Any]:
    """Writes a preview with `step` Gaussians and returns its event."""
    name = f"previews/step_{step:06d}.ply"
    save_splats(run / name, gaussians(step))
    return {"kind": "preview", "step": step, "path": name}


def test_a_follower_passes_over_previews_that_are_no_longer_the_newest(run: Path) -> None:
    follower = run_follower.RunFollower(run)
    assert follower.poll() is None
    emit(run, {"kind": "started"}, preview(run, 1), preview(run, 2), {"kind": "progress", "step": 3})
    update = follower.poll()
    assert update is not None
    assert update.splats == (run / "previews/step_000002.ply").resolve()
    assert follower.poll() is None


@pytest.mark.parametrize("last", ["done", "stopped", "error"])
def test_a_run_that_ended_shows_its_result(run: Path, last: str) -> None:
    save_splats(run / "splat.ply", gaussians())
    emit(run, preview(run, 1), {"kind": last})
    update = run_follower.RunFollower(run).poll()
    assert update == run_follower.Update((run / "splat.ply").resolve(), last)


def test_a_run_that_ended_without_a_result_keeps_the_last_preview(run: Path) -> None:
    emit(run, preview(run, 1), {"kind": "error"})
    update = run_follower.RunFollower(run).poll()
    assert update == run_follower.Update((run / "previews/step_000001.ply").resolve(), "error")


NO_PATHS = ["../outside.ply", "/etc/hostname", None, 7, "previews", "previews/absent.ply"]
NO_PATHS += ["a\0b.ply", "\ud800.ply", "caf\udce9.ply", "x" * 300, "x/" * 3000, "circle/a.ply", ["previews"], ""]


@pytest.mark.parametrize("path", NO_PATHS)
def test_a_path_that_leads_out_of_the_run_or_nowhere_is_ignored(run: Path, path: object) -> None:
    save_splats(run.parent / "outside.ply", gaussians())
    (run / "circle").symlink_to("circle")
    emit(run, {"kind": "preview", "step": 1, "path": path})
    update = run_follower.RunFollower(run).poll()
    assert update is None or update.splats is None


@pytest.mark.parametrize("step", [None, "{alert(1)}", "![](http://evil.example)", [[1]], True, 1.5])
def test_a_caption_holds_no_text_of_the_events(run: Path, step: object) -> None:
    emit(run, {**preview(run, 1), "step": step})
    update = run_follower.RunFollower(run).poll()
    assert update is not None
    assert update.caption == "preview"


class Recorder:
    """A fake of viser that records the calls on its scene."""

    def __init__(self) -> None:
        self.server = MagicMock()

    def told(self, what: str) -> list[SimpleNamespace]:
        calls = getattr(self.server.scene, what).call_args_list
        return [SimpleNamespace(args=call.args, **call.kwargs) for call in calls]


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    fake = Recorder()
    monkeypatch.setattr(viewer, "start_server", lambda *_: fake.server)
    return fake


def test_frusta_stand_and_look_as_the_cameras_do(recorder: Recorder) -> None:
    viewer.SplatViewer("127.0.0.1", 0).show_cameras(cameras(), radius=1.0)
    frusta = recorder.told("add_camera_frustum")
    assert len({frustum.args[0] for frustum in frusta}) == len(EYES)
    for frustum, eye in zip(frusta, EYES, strict=True):
        torch.testing.assert_close(torch.from_numpy(frustum.position), eye)
        forward = rotation_matrices(torch.from_numpy(frustum.wxyz))[:, 2]
        torch.testing.assert_close(forward, -eye / eye.norm())
        assert math.tan(frustum.fov / 2) * frustum.aspect == pytest.approx(math.tan(0.8 / 2))


def test_up_is_where_the_cameras_have_it(recorder: Recorder) -> None:
    viewer.SplatViewer("127.0.0.1", 0).show_cameras(cameras(), radius=1.0)
    (call,) = recorder.told("set_up_direction")
    torch.testing.assert_close(torch.tensor(call.args[0], dtype=torch.float64), UP)


def test_up_of_cameras_that_cancel_is_still_a_direction() -> None:
    turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    camera = cameras()[0]
    upside_down = Cameras(turned @ camera.viewmats, camera.Ks, camera.width, camera.height)
    torch.testing.assert_close(viewer.mean_up([camera, upside_down]), UP)


def test_splats_are_sent_after_activation(recorder: Recorder) -> None:
    model = gaussians()
    viewer.SplatViewer("127.0.0.1", 0).show_splats(model, "caption")
    (splats,) = recorder.told("add_gaussian_splats")
    torch.testing.assert_close(torch.from_numpy(splats.opacities)[:, 0], model.opacities)
    variances = torch.linalg.eigvalsh(torch.from_numpy(splats.covariances))
    torch.testing.assert_close(variances, model.scales.square().sort(dim=1).values, rtol=1e-4, atol=1e-6)
    assert splats.rgbs.min() >= 0
    assert splats.rgbs.max() <= 1


def test_the_name_of_a_file_is_displayed_as_plain_text(recorder: Recorder, tmp_path: Path) -> None:
    save_splats(tmp_path / "{alert(1)}caf\udce9.ply", gaussians())
    viewer.view_file(viewer.SplatViewer("127.0.0.1", 0), tmp_path / "{alert(1)}caf\udce9.ply")
    recorder.server.gui.add_markdown.assert_not_called()
    assert recorder.server.gui.add_text.return_value.value == "{alert(1)}caf\\udce9.ply: 5 Gaussians"


@pytest.mark.parametrize("n", [0, 1, 7])
def test_the_extent_of_any_number_of_points_is_positive_and_moves_with_them(n: int) -> None:
    points = gaussians(n).means
    center, radius = viewer.center_and_radius(points)
    moved_center, moved_radius = viewer.center_and_radius(points + 10)
    assert radius > 0
    assert moved_radius == pytest.approx(radius, rel=1e-4)
    if n:
        torch.testing.assert_close(moved_center, center + 10)


def test_a_run_shows_each_new_preview_and_its_cameras_once(run: Path, recorder: Recorder) -> None:
    lines = viewer.view_run(viewer.SplatViewer("127.0.0.1", 0), run)
    assert next(lines) == ""
    for step in (1, 2):
        emit(run, preview(run, step))
        assert list(itertools.islice(lines, 2)) == [f"step {step}", ""]
    assert [len(call.centers) for call in recorder.told("add_gaussian_splats")] == [1, 2]
    assert len(recorder.told("add_camera_frustum")) == len(EYES)


def test_a_run_whose_photos_are_gone_is_still_shown(run: Path, recorder: Recorder) -> None:
    (run.parent / "scene").rename(run.parent / "elsewhere")
    emit(run, preview(run, 1))
    lines = viewer.view_run(viewer.SplatViewer("127.0.0.1", 0), run)
    assert "no input cameras" in next(lines)
    assert next(lines) == "step 1"


@pytest.mark.parametrize("target", ["absent", "empty"])
def test_what_is_neither_a_run_nor_a_file_is_an_input_error(tmp_path: Path, target: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=target):
        viewer.serve(tmp_path / target, "127.0.0.1", 0, once=True)


def test_without_viser_the_message_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependency, match=r"gsopt\[viewer\]"):
        viewer.SplatViewer("127.0.0.1", 0)


def test_view_once_serves_a_run_and_a_file(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    emit(run, preview(run, 3), {"kind": "started"})
    assert cli.main(["view", str(run), "--port", "0", "--once"]) == 0
    out = capsys.readouterr().out
    assert "http://127.0.0.1:" in out
    assert "step 3" in out
    assert cli.main(["view", str(run / "previews/step_000003.ply"), "--port", "0", "--once"]) == 0


def test_the_opening_view_is_an_input_camera_filled_by_the_splats(recorder: Recorder, run: Path) -> None:
    """Solid splats near the origin: their extreme pixels under the opening camera span most of its height or width."""
    model = gaussians(200)
    model.means[:] *= 0.15
    model.logit_opacities[:] = 3
    shown = viewer.SplatViewer("127.0.0.1", 0)
    viewer.frame_run(shown, model, load_scene(TrainConfig.read(run / "config.json").data))
    camera = recorder.server.initial_camera
    eye, target, up = (torch.tensor(v, dtype=torch.float64) for v in (camera.position, camera.look_at, camera.up))
    torch.testing.assert_close(eye.float(), EYES[0].float())
    t = (model.means.double() - eye) @ look_at(eye[None], target, up)[0, :3, :3].T
    height = (t[:, 1] / t[:, 2]).abs().max() / math.tan(camera.fov / 2)
    width = (t[:, 0] / t[:, 2]).abs().max() / math.tan(camera.fov / 2) / 2
    assert 0.75 < float(max(height, width)) < 1.1


def test_the_size_slider_shrinks_splats_to_points_and_the_degree_slider_changes_colors(recorder: Recorder) -> None:
    model = Gaussians(**{**dict(gaussians().items()), "shN": torch.rand(5, 15, 3, generator=torch.manual_seed(1))})
    shown = viewer.SplatViewer("127.0.0.1", 0)
    shown.look_from(torch.tensor([3.0, 0, 0]), torch.zeros(3))
    shown.show_splats(model, "caption")
    (splats,) = recorder.told("add_gaussian_splats")
    handle = recorder.server.scene.add_gaussian_splats.return_value
    shown.set_look(scale=0.5)
    assert handle.covariances == pytest.approx(splats.covariances / 4)
    shown.set_look(scale=0.0)
    assert not handle.covariances.any()
    shown.set_look(degree=0)
    assert handle.rgbs == pytest.approx((model.sh0[:, 0] * 0.28209479 + 0.5).clamp(0, 1).numpy(), abs=1e-6)
    shown.set_look(degree=3)
    assert handle.rgbs == pytest.approx(splats.rgbs)


def test_what_no_photo_shows_is_marked_while_the_box_is_ticked(recorder: Recorder) -> None:
    shown, model = viewer.SplatViewer("127.0.0.1", 0), gaussians(40)
    shown.show_cameras(cameras()[:1], radius=1.0)
    shown.show_splats(model, "caption")
    (splats,) = recorder.told("add_gaussian_splats")
    handle = recorder.server.scene.add_gaussian_splats.return_value
    shown.set_look(mark=True)
    hidden = viewer.unseen(model, cameras()[:1]).numpy()
    assert 0 < hidden.sum() < 40
    assert ((handle.rgbs != splats.rgbs).any(axis=1) == hidden).all()
    shown.set_look(mark=False)
    assert (handle.rgbs == splats.rgbs).all()


def test_colors_follow_the_eye_of_the_visitor(recorder: Recorder) -> None:
    model = Gaussians(**{**dict(gaussians().items()), "shN": torch.rand(5, 3, 3, generator=torch.manual_seed(1))})
    shown = viewer.SplatViewer("127.0.0.1", 0)
    shown.look_from(torch.tensor([3.0, 0, 0]), torch.zeros(3))
    shown.show_splats(model, "caption")
    handle = recorder.server.scene.add_gaussian_splats.return_value
    handle.rgbs = "old"
    shown._follow_eye(SimpleNamespace(position=(3.0, 0.001, 0)))
    shown.refresh()
    assert handle.rgbs == "old"  # hardly moved
    shown._follow_eye(SimpleNamespace(position=(0.0, 3.0, 0)))
    shown.refresh()
    direction = torch.nn.functional.normalize(model.means - torch.tensor([0.0, 3, 0]), dim=1)
    expected = sh.evaluate(model.sh0, model.shN, direction, 1).clamp(0, 1)
    torch.testing.assert_close(torch.from_numpy(handle.rgbs), expected)


def test_cameras_carry_their_photos(recorder: Recorder, run: Path) -> None:
    emit(run, preview(run, 1))
    next(viewer.view_run(viewer.SplatViewer("127.0.0.1", 0), run))
    for frustum in recorder.told("add_camera_frustum"):
        assert frustum.image.shape == (SIZE, 2 * SIZE, 3)
        assert frustum.image[0, 0].tolist() == [200, 100, 50]


def test_progress_is_shown_and_the_button_asks_the_run_to_stop(run: Path, recorder: Recorder) -> None:
    gui = recorder.server.gui
    bar, button = gui.add_progress_bar.return_value, gui.add_button.return_value
    lines = viewer.view_run(viewer.SplatViewer("127.0.0.1", 0), run)
    next(lines)
    assert not bar.visible
    emit(run, {"kind": "progress", "step": 30, "total": 120})
    next(lines)
    assert (bar.visible, button.visible, bar.value) == (True, True, 25.0)
    button.on_click.call_args.args[0](None)
    assert (run / "stop").read_bytes() == b""
    emit(run, {"kind": "stopped", "step": 31})
    next(lines)
    assert (bar.visible, button.visible) == (False, False)


@pytest.mark.parametrize("event", [{"step": "1", "total": 2}, {"step": True, "total": 2}, {"step": 1, "total": 0}, {}])
def test_progress_that_makes_no_sense_is_no_progress(run: Path, event: dict[str, Any]) -> None:
    emit(run, {"kind": "progress", **event})
    follower = run_follower.RunFollower(run)
    follower.poll()
    assert follower.share is None


def test_a_link_in_the_place_of_the_stop_file_is_not_followed(run: Path) -> None:
    (run / "stop").symlink_to(run.parent / "dear")
    viewer_controls.ask_to_stop(run)
    assert (run / "stop").is_file()
    assert not (run.parent / "dear").exists()


def test_a_held_out_view_stands_beside_its_render_and_error(recorder: Recorder, tmp_path: Path) -> None:
    """Splats that made the view: truth and render agree, the error is dark; none at all: it is not."""
    made = make_run(tmp_path, test=2)
    config = TrainConfig.read(made / "config.json")
    views = load_scene(config.data).test
    panel = viewer_controls.held_out_views(recorder.server, views, config, made)
    assert panel is not None
    right, nothing = (panel.panes(model) for model in (splats(), splats().select(torch.zeros(0, dtype=torch.int64))))
    truth, render, error = np.split(right, 3, axis=1)
    assert np.abs(truth.astype(int) - render).mean() < 6
    assert error.mean() < np.split(nothing, 3, axis=1)[2].mean()
    assert viewer_controls.held_out_views(recorder.server, (), config, made) is None


def test_splats_without_cameras_are_seen_from_aside_and_above(recorder: Recorder) -> None:
    """From (2, 2, 1) radii off the center: three radii away, so that all of them are in the picture."""
    model = gaussians(200)
    model.means[:] += torch.tensor([5.0, -3.0, 2.0])
    shown = viewer.SplatViewer("127.0.0.1", 0)
    viewer.frame_run(shown, model, None)
    center, radius = viewer.center_and_radius(model.means)
    camera = recorder.server.initial_camera
    torch.testing.assert_close(torch.tensor(camera.position).float(), center + radius * torch.tensor([2.0, 2.0, 1.0]))
    torch.testing.assert_close(torch.tensor(camera.look_at).float(), center)


def test_a_held_out_view_is_rendered_again_with_each_preview(recorder: Recorder, tmp_path: Path) -> None:
    made = make_run(tmp_path, test=2)
    emit(made, {"kind": "done", "step": 100})
    image = recorder.server.gui.add_image.return_value
    image.image = None
    assert next(viewer.view_run(viewer.SplatViewer("127.0.0.1", 0), made)) == "done"
    assert isinstance(image.image, np.ndarray)
