"""COLMAP folders, binary and text."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import POINTS, SIZE, colmap, ring, save_image
from PIL import Image

from gsopt.config.train import DataConfig
from gsopt.data.colmap import _camera_model
from gsopt.data.colmap_files import CAMERA_MODELS, CameraRecord
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.init.neighbors import mean_neighbor_distance

UNSUPPORTED = ("FOV", "RAD_TAN_THIN_PRISM_FISHEYE")


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_poses_intrinsics_points_and_order(tmp_path: Path, suffix: str) -> None:
    scene = load_scene(colmap(tmp_path, suffix=suffix))
    assert scene.kind == "colmap"
    assert [view.name for view in scene.train] == [f"images/im {i:03d}.png" for i in range(10)]
    assert scene.test == ()
    for i, (view, viewmat) in enumerate(zip(scene.train, ring(10), strict=True)):
        assert torch.allclose(view.camera.viewmats[0].double(), viewmat, atol=1e-6)
        want = np.random.default_rng(i).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)
        assert np.array_equal(view.pixels().numpy(), want)
    assert scene.train[0].camera.Ks[0].tolist() == [[20, 0, 7.5], [0, 21, 8.25], [0, 0, 1]]
    assert scene.points is not None
    assert scene.points.xyz.tolist() == torch.tensor([xyz for xyz, _, _ in POINTS]).tolist()
    assert scene.points.rgb.tolist() == [rgb for _, rgb, _ in POINTS]


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300, -1e300, 1e40, 1e20, 1e12])
def test_points_beyond_all_bounds_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, value: float
) -> None:
    """The run would end in NaN, or start with every other point on one place in float32."""
    near = [([i % 5 / 5, i % 7 / 7, i % 11 / 11], [i, 0, 0], 0) for i in range(30)]
    far = [([value, 0.0, 0.0], [255, 255, 255], 0), ([0.0, 1.0, value], [255, 255, 255], 2)]
    monkeypatch.setattr("dataset_builders.POINTS", [far[0], *near, far[1]])
    scene = load_scene(colmap(tmp_path, suffix=suffix))
    assert scene.points is not None
    assert scene.points.xyz.tolist() == torch.tensor([xyz for xyz, _, _ in near]).tolist()
    assert scene.points.rgb.tolist() == [rgb for _, rgb, _ in near]
    assert bool(mean_neighbor_distance(scene.points.xyz).isfinite().all())
    if math.isfinite(value):
        assert "2 of 32 points lie more than 1,000,000 times as far out as half of them" in scene.warnings[0]


def test_points_on_one_place_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [([1.0, 2.0, 3.0], [i, 0, 0], 0) for i in range(5)]
    monkeypatch.setattr("dataset_builders.POINTS", [*points, ([4.0, 2.0, 3.0], [9, 9, 9], 0)])
    scene = load_scene(colmap(tmp_path))
    assert scene.points is not None
    assert len(scene.points.xyz) == 6


def test_the_model_may_lie_in_sparse_itself(tmp_path: Path) -> None:
    colmap(tmp_path)
    for file in (tmp_path / "sparse" / "0").iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    assert len(load_scene(tmp_path).train) == 10


def test_test_txt_is_held_out_before_every_eighth(tmp_path: Path) -> None:
    colmap(tmp_path)
    scene = load_scene(DataConfig(path=str(tmp_path), eval=True))
    assert [view.name for view in scene.test] == ["images/im 000.png", "images/im 008.png"]
    assert len(scene.train) == 8
    (tmp_path / "sparse" / "0" / "test.txt").write_text("im 003.png\nim 001.png\n")
    for evaluate in (False, True):
        scene = load_scene(DataConfig(path=str(tmp_path), eval=evaluate))
        assert [view.name for view in scene.test] == ["images/im 001.png", "images/im 003.png"]
        assert len(scene.train) == 8


def test_absent_images_are_named(tmp_path: Path) -> None:
    colmap(tmp_path)
    (tmp_path / "images" / "im 004.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.train) == 9
    assert "im 004.png" in scene.warnings[0]


@pytest.mark.parametrize("ending", [".png.png", ".png"])
def test_masks_are_found_by_either_name(tmp_path: Path, ending: str) -> None:
    colmap(tmp_path)
    for i in range(10):
        save_image(tmp_path / "masks" / f"im {i:03d}{ending}", np.eye(SIZE, dtype=np.uint8) * 255)
    scene = load_scene(tmp_path)
    assert scene.has_alpha
    assert np.array_equal(scene.train[5].pixels()[..., 3], np.eye(SIZE) * 255)
    (tmp_path / "masks" / f"im 005{ending}").unlink()
    scene = load_scene(tmp_path)
    assert not scene.has_alpha
    assert "im 005" in scene.warnings[0]


def test_predownscaled_images_are_used_where_they_match(tmp_path: Path) -> None:
    colmap(tmp_path)
    for i in range(9):
        save_image(tmp_path / "images_2" / f"im {i:03d}.png", np.full((8, 8, 3), i, np.uint8))
    scene = load_scene(DataConfig(path=str(tmp_path), downscale=2))
    assert scene.train[3].pixels().unique().tolist() == [3]
    assert len(scene.train[9].pixels().unique()) > 3  # not there: box filter from images/
    assert {(view.camera.width, view.camera.height) for view in scene.train} == {(8, 8)}
    assert torch.equal(scene.train[3].camera.Ks, scene.train[9].camera.Ks)
    assert len(load_scene(DataConfig(path=str(tmp_path), downscale=4)).train[3].pixels().unique()) > 3


def test_a_predownscaled_image_of_another_size_is_refused(tmp_path: Path) -> None:
    colmap(tmp_path)
    save_image(tmp_path / "images_2" / "im 000.png", np.zeros((5, 8, 3), np.uint8))
    with pytest.raises(InputError, match=r"8x5 pixels, but the dataset declares 8x8"):
        load_scene(DataConfig(path=str(tmp_path), downscale=2))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize(("model", "count"), [m for m in CAMERA_MODELS if m[0] not in UNSUPPORTED])
def test_every_common_model_loads(tmp_path: Path, model: str, count: int, suffix: str) -> None:
    shared = model.startswith(("SIMPLE", "RADIAL"))
    head = (20.0, 8.0, 8.0) if shared else (20.0, 20.0, 8.0, 8.0)
    params = (*head, *(0.01 for _ in range(count - len(head))))
    scene = load_scene(colmap(tmp_path, 3, suffix, model, params))
    assert scene.train[0].pixels().shape == (SIZE, SIZE, 3)
    assert scene.train[0].camera.Ks[0, 0, 2] == 8


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_the_fov_model_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    colmap(tmp_path, 3, suffix, "FOV", (20.0, 20.0, 8.0, 8.0, 0.9))
    with pytest.raises(InputError, match="FOV"):
        load_scene(tmp_path)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_a_huge_count_is_refused_before_allocating(tmp_path: Path, stem: str) -> None:
    path = colmap(tmp_path) / "sparse" / "0" / f"{stem}.bin"
    path.write_bytes(struct.pack("<Q", 10**12) + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{stem}\.bin declares 1,000,000,000,000 records"):
        load_scene(tmp_path)


def test_a_huge_keypoint_count_is_refused(tmp_path: Path) -> None:
    path = colmap(tmp_path) / "sparse" / "0" / "images.bin"
    data = bytearray(path.read_bytes())
    start = 8 + 64 + len("im 009.png") + 1
    data[start : start + 8] = struct.pack("<Q", 2**63)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"images\.bin declares"):
        load_scene(tmp_path)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_every_truncation_is_an_input_error_or_a_shorter_scene(tmp_path: Path, stem: str, suffix: str) -> None:
    path = colmap(tmp_path, 3, suffix) / "sparse" / "0" / f"{stem}{suffix}"
    data = path.read_bytes()
    messages = []
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        try:
            load_scene(tmp_path)
        except InputError as error:
            messages.append(str(error))
    assert messages or suffix == ".txt"
    assert all(str(tmp_path) in message for message in messages)


@pytest.mark.parametrize(
    ("quat", "message"), [("0 0 0 0", "not rigid"), ("nan 0 0 0", "not rigid"), ("1 0 0", "line 2")]
)
def test_a_broken_pose_names_its_image(tmp_path: Path, quat: str, message: str) -> None:
    path = colmap(tmp_path, 3, ".txt") / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    words = lines[1].split()
    lines[1] = " ".join([words[0], *quat.split(), *words[5:]])
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=message) as caught:
        load_scene(tmp_path)
    assert "im 002.png" in str(caught.value) or "line 2" in message


def test_a_quaternion_of_any_length_is_the_same_rotation(tmp_path: Path) -> None:
    before = load_scene(colmap(tmp_path / "a", 3, ".txt"))
    path = colmap(tmp_path / "b", 3, ".txt") / "sparse" / "0" / "images.txt"
    lines = path.read_text().splitlines()
    for row, line in enumerate(lines):
        words = line.split()
        if words and words[-1].endswith(".png"):
            lines[row] = " ".join([words[0], *(str(3 * float(word)) for word in words[1:5]), *words[5:]])
    path.write_text("\n".join([*lines, ""]))
    after = load_scene(tmp_path / "b")
    for one, other in zip(before.train, after.train, strict=True):
        torch.testing.assert_close(one.camera.viewmats, other.camera.viewmats)


def test_declared_and_actual_size_are_both_named(tmp_path: Path) -> None:
    colmap(tmp_path)
    Image.new("RGB", (12, 16)).save(tmp_path / "images" / "im 006.png")
    with pytest.raises(InputError, match=r"im 006\.png is 12x16 pixels, but the dataset declares 16x16"):
        load_scene(tmp_path)


@pytest.mark.parametrize(("model", "params"), [("SIMPLE_PINHOLE", [0, 8, 8]), ("PINHOLE", [20, 0, 8, 8])])
@pytest.mark.parametrize("sign", [0.0, -1.0])
def test_a_focal_length_that_is_not_positive_is_refused(model: str, params: list[float], sign: float) -> None:
    camera = CameraRecord(1, model, 16, 16, tuple(value or sign for value in params))
    with pytest.raises(InputError, match="all must be positive"):
        _camera_model(camera, "here")
    K, _ = _camera_model(replace(camera, params=tuple(value or 1e-3 for value in params)), "here")
    assert float(K.diagonal()[:2].min()) == 1e-3
