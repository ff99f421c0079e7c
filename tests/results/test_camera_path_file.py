"""Camera paths leave as nerfstudio's JSON and come back as the same cameras; a broken file is one clear line."""

from __future__ import annotations

import contextlib
import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from finished_runs import make_run, ring

from gsopt.cli import main
from gsopt.errors import InputError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.quats import from_rotation_matrices
from gsopt.results.camera_path_file import read_camera_path, write_camera_path
from gsopt.results.viewer_path import KeyframeControls, camera_of

ORIGIN = (1000.0, -2000.0, 5.0)


def document() -> dict:
    pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1]
    return {"render_width": 8, "render_height": 6, "camera_path": [{"camera_to_world": pose, "fov": 50.0}]}


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), ORIGIN])
def test_a_path_comes_back_as_the_same_cameras(tmp_path: Path, origin: tuple[float, float, float]) -> None:
    shots = ring(5)
    write_camera_path(tmp_path / "p.json", [shots[i] for i in range(5)], 24.0, origin)
    found = read_camera_path(tmp_path / "p.json", origin)
    assert len(found) == 5
    for row, camera in enumerate(found):
        assert torch.allclose(camera.viewmats[0], shots.viewmats[row], atol=1e-5)
        assert torch.allclose(camera.Ks[0], shots.Ks[row], atol=1e-3)
        assert (camera.width, camera.height) == (shots.width, shots.height)


def test_the_file_says_what_nerfstudio_reads(tmp_path: Path) -> None:
    """A camera at z = 3 that looks down the z axis, as OpenGL's do, with half the height at 3 tan(25 degrees)."""
    (tmp_path / "p.json").write_text(json.dumps(document()))
    camera = read_camera_path(tmp_path / "p.json")[0]
    assert camera.centers[0].tolist() == [0, 0, 3]
    assert camera.forwards[0].tolist() == [0, 0, -1]
    assert float(camera.Ks[0, 1, 1]) == pytest.approx(3 / 0.4663077, rel=1e-5)


def test_a_written_file_has_the_fields_of_nerfstudio(tmp_path: Path) -> None:
    """Three cameras at two frames per second; 32 rows at 80 px focal length are 2 atan(0.2)."""
    K = torch.tensor([[[80.0, 0, 20], [0, 80, 16], [0, 0, 1]]])
    camera = Cameras(torch.eye(4)[None], K, 40, 32)
    write_camera_path(tmp_path / "p.json", [camera] * 3, 2.0, (1.0, 2.0, 3.0))
    found = json.loads((tmp_path / "p.json").read_text())
    assert (found["render_width"], found["render_height"], found["fps"], found["seconds"]) == (40, 32, 2, 1.5)
    assert (found["camera_type"], found["keyframes"], len(found["camera_path"])) == ("perspective", [], 3)
    entry = found["camera_path"][0]
    assert entry["aspect"] == 1.25
    assert entry["fov"] == pytest.approx(math.degrees(2 * math.atan(0.2)))
    assert entry["camera_to_world"] == [1, 0, 0, 1, 0, -1, 0, 2, 0, 0, -1, 3, 0, 0, 0, 1]


def test_a_run_is_rendered_along_a_file_that_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, path = make_run(tmp_path), tmp_path / "path.json"
    assert main(["render", str(run), "--path", "orbit", "--frames", "3", "-o", str(path)]) == 0
    assert "3 cameras" in capsys.readouterr().out
    for name, source in (("a", "orbit"), ("b", str(path))):
        assert main(["render", str(run), "--path", source, "--frames", "3", "-o", str(tmp_path / name)]) == 0
    pictures = [sorted((tmp_path / name).glob("*.png")) for name in "ab"]
    assert [picture.name for picture in pictures[0]] == [picture.name for picture in pictures[1]]
    assert len(pictures[0]) == 3
    capsys.readouterr()
    assert main(["render", str(run), "-o", str(path)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["render", str(run), "--path", "spiral"]) == 2
    assert "turntable" in capsys.readouterr().err


def scaled(*by: float) -> list[float]:
    """A matrix that stretches the axes."""
    return [by[0], 0, 0, 0, 0, by[1], 0, 0, 0, 0, by[2], 3, 0, 0, 0, 1]


@pytest.mark.parametrize(
    "change",
    [
        *(
            {"camera_path": [{"fov": 50, "camera_to_world": scaled(*by)}]}
            for by in ((1.01, 1, 1), (1, 1, 0), (1, -1, 1))
        ),
        {"render_width": 0},
        {"render_height": 1e9},
        {"render_width": True},
        {"camera_path": []},
        {"camera_path": {}},
        {"camera_path": [3]},
        {"camera_path": [{"fov": 50}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [1] * 16}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [float("nan")] * 16}]},
        {"camera_path": [{"fov": 50, "camera_to_world": [10**400] * 16}]},
        {"camera_path": [{**document()["camera_path"][0], "fov": 180}]},
        {"camera_type": "equirectangular"},
    ],
)
def test_a_broken_file_is_bad_data_in_one_line(tmp_path: Path, capsys, change: dict) -> None:
    path = tmp_path / "p.json"
    path.write_text(json.dumps(document() | change))
    with pytest.raises(InputError, match=r"p\.json"):
        read_camera_path(path)
    assert main(["render", str(make_run(tmp_path)), "--path", str(path)]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1


def visitor(camera: Cameras) -> SimpleNamespace:
    """A browser of viser whose camera stands where this one does."""
    world_from_cam = torch.linalg.inv(camera.viewmats[0].double())
    return SimpleNamespace(
        camera=SimpleNamespace(
            wxyz=from_rotation_matrices(world_from_cam[:3, :3]).numpy(),
            position=world_from_cam[:3, 3].numpy(),
            look_at=(0.0, 0.0, 0.0),
            fov=2 * math.atan(camera.height / 2 / float(camera.Ks[0, 1, 1])),
            image_width=camera.width,
            image_height=camera.height,
        ),
        send_file_download=MagicMock(),
        add_notification=MagicMock(),
        atomic=contextlib.nullcontext,
    )


def test_a_visitor_sees_by_a_camera_of_square_pixels_about_the_center_of_the_image() -> None:
    shot = ring(1)
    found = camera_of(visitor(shot).camera)
    assert torch.allclose(found.viewmats[0].float(), shot.viewmats[0], atol=1e-5)
    focal = float(shot.Ks[0, 1, 1])
    expected = torch.tensor([[focal, 0, shot.width / 2], [0, focal, shot.height / 2], [0, 0, 1]])
    torch.testing.assert_close(found.Ks[0].float(), expected)


def test_keyframes_of_the_viewer_are_saved_as_a_path_through_them(tmp_path: Path, monkeypatch) -> None:
    shots = ring(3)
    controls = KeyframeControls(MagicMock())
    controls.origin = ORIGIN
    guests = [visitor(shots[i]) for i in range(3)]
    controls.save(guests[0])
    guests[0].add_notification.assert_called_once()
    guests[0].send_file_download.assert_not_called()
    for guest in (*guests, guests[0]):
        controls.add(guest)
    controls.remove(guests[0])
    controls.save(guests[0])
    name, data = guests[0].send_file_download.call_args.args
    (tmp_path / name).write_bytes(data)
    found = read_camera_path(tmp_path / name, ORIGIN)
    assert len(found) == 97
    for row, place in enumerate((0, 48, 96)):
        assert torch.allclose(found[place].viewmats[0], shots.viewmats[row], atol=1e-4)
        assert torch.allclose(found[place].Ks[0], shots.Ks[row], rtol=1e-4)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    controls.play(guests[0])
    assert torch.allclose(torch.tensor(guests[0].camera.position), shots.centers[2].double(), atol=1e-4)
    ahead = torch.tensor(guests[0].camera.look_at) - torch.tensor(guests[0].camera.position)
    assert torch.allclose(ahead / ahead.norm(), shots.forwards[2].double(), atol=1e-4)
    half = math.atan(shots.height / 2 / float(shots.Ks[2, 1, 1]))
    assert guests[0].camera.fov == pytest.approx(2 * half, rel=1e-4)
