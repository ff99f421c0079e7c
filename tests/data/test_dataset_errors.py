"""Every fault of a dataset has one message: what, got, do."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from dataset_builders import SIZE, nerf_synthetic, nerfstudio, read_document, write_json
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from gsopt.data.scene import load_scene
from gsopt.errors import GsoptError, InputError


def test_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere does not exist"):
        load_scene(tmp_path / "nowhere")


def test_a_file_instead_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(InputError, match="is no folder"):
        load_scene(tmp_path / "a.json")


def test_a_folder_of_photos_points_to_sfm(tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "photo.jpg")
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path)
    for looked_for in ("sparse/0", "transforms_train.json", "transforms.json", "gsopt sfm"):
        assert looked_for in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"  \n", "is empty"),
        (b'{"frames": [', "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b"[" * 100_000, "not valid JSON"),
        (b"[]", "must hold a JSON object, got list"),
        (b"{}", "no list `frames`"),
        (b'{"frames": []}', "no list `frames`"),
        (b'{"frames": [3]}', r"frames\[0\] must be an object"),
        (b'{"frames": [{"file_path": 3}]}', r"frames\[0\] must be an object"),
    ],
)
def test_broken_json(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(tmp_path)
    assert "transforms.json" in str(caught.value)


def edited(root: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    document = read_document(nerfstudio(root))
    change(document)
    write_json(root, document)
    return root


def set_pose(row: int, column: int, value: object) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        document["frames"][3]["transform_matrix"][row][column] = value

    return change


def scale_pose(document: dict[str, Any]) -> None:
    pose = document["frames"][3]["transform_matrix"]
    document["frames"][3]["transform_matrix"] = [[2 * value for value in row[:3]] + row[3:] for row in pose[:3]] + [
        pose[3]
    ]


def mirror_pose(document: dict[str, Any]) -> None:
    for row in document["frames"][3]["transform_matrix"]:
        row[0] = -row[0]


def flatten_pose(document: dict[str, Any]) -> None:
    document["frames"][3]["transform_matrix"] = [[0.0] * 4] * 4


def set_key(key: str, value: object) -> Callable[[dict[str, Any]], None]:
    return lambda document: document.update({key: value})


def without_focal(angle: float) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        del document["fl_x"]
        document["camera_angle_x"] = angle

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_pose(0, 0, float("nan")), "not finite"),
        (set_pose(1, 3, float("inf")), "not finite"),
        (set_pose(3, 3, 2.0), "last row"),
        (set_pose(0, 0, "left"), "must hold numbers"),
        (set_pose(0, 0, None), "must hold numbers"),
        (set_pose(0, 0, 10**400), "must hold numbers"),
        (scale_pose, "not a rotation"),
        (mirror_pose, "mirrored"),
        (flatten_pose, "not a rotation"),
        (lambda d: d["frames"][3].pop("transform_matrix"), "must be 4 rows of 4 numbers"),
        (lambda d: d["frames"][3].update(transform_matrix=[[1, 0], [0, 1]]), "must be 4 rows of 4 numbers"),
        (lambda d: d["frames"][3]["transform_matrix"][1].pop(), "must be 4 rows of 4 numbers"),
    ],
)
def test_a_broken_pose_names_its_frame(tmp_path: Path, change: Callable[..., None], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_scene(edited(tmp_path, change))
    assert "images/006.png" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_key("w", SIZE + 1), "16x16 pixels, but the dataset declares 17x16"),
        (set_key("h", "tall"), "`h` of frame 'images/000.png'"),
        (set_key("w", 0), "at least 1"),
        (set_key("fl_x", -3), "must be positive"),
        (set_key("fl_x", float("nan")), "`fl_x` of frame"),
        (set_key("fl_x", 10**400), "`fl_x` of frame"),
        (lambda d: d.pop("fl_x"), "neither `fl_x` nor `camera_angle_x`"),
        (without_focal(0.0), r"`camera_angle_x` of .* must be in \(0, pi\) radians, got 0"),
        (without_focal(-0.5), r"`camera_angle_x` of .* must be in \(0, pi\) radians, got -0.5"),
        (without_focal(3.1416), r"`camera_angle_x` of .* must be in \(0, pi\) radians, got 3.1416"),
        (without_focal(4.0), r"`camera_angle_x` of .* must be in \(0, pi\) radians, got 4.0"),
        (set_key("camera_model", "EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (set_key("k1", -5000), "folds back"),
        (set_key("ply_file_path", "images/000.png"), "not a PLY file"),
    ],
)
def test_a_broken_value_is_named(tmp_path: Path, change: Callable[..., None], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_scene(edited(tmp_path, change))


def test_a_truncated_image_is_named_when_it_is_read(tmp_path: Path) -> None:
    scene = load_scene(nerf_synthetic(tmp_path))
    path = tmp_path / "train" / "r_3.png"
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"r_3\.png"):
        scene.train[3].pixels()


def test_one_remaining_image_is_too_few(tmp_path: Path) -> None:
    nerfstudio(tmp_path)
    for i in range(1, 10):
        (tmp_path / "images" / f"{i:03d}.png").unlink()
    with pytest.raises(InputError, match=r"Only 1 of the 10 images.*absent are images/002\.png"):
        load_scene(tmp_path)


def test_no_remaining_image_is_named(tmp_path: Path) -> None:
    nerfstudio(tmp_path)
    for i in range(10):
        (tmp_path / "images" / f"{i:03d}.png").unlink()
    with pytest.raises(InputError, match=r"images/000\.png"):
        load_scene(tmp_path)


def test_a_ply_that_promises_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    nerfstudio(tmp_path, ply_file_path="cloud.ply")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\n{properties}end_header\n"
    (tmp_path / "cloud.ply").write_text(head)
    with pytest.raises(InputError, match="declares 1000000000000 rows"):
        load_scene(tmp_path)


def test_a_ply_whose_colors_are_lists_is_refused(tmp_path: Path) -> None:
    nerfstudio(tmp_path, ply_file_path="cloud.ply")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    properties += "".join(f"property list uchar uchar {color}\n" for color in ("red", "green", "blue"))
    rows = "0 0 0 2 1 1 1 1 1 1\n1 1 1 1 2 1 2 1 2\n"
    (tmp_path / "cloud.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n{rows}")
    with pytest.raises(InputError, match=r"Cannot read the points .*cloud\.ply"):
        load_scene(tmp_path)


junk = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
KEYS = ["fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "p2", "camera_model", "camera_angle_x", "frames", "ply_file_path"]
FRAME_KEYS = ["file_path", "transform_matrix", "mask_path", "fl_x", "w"]


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(st.sampled_from(KEYS), junk, max_size=2),
    st.dictionaries(st.sampled_from(FRAME_KEYS), junk, max_size=2),
)
def test_any_junk_gives_a_scene_or_our_own_error(tmp_path: Path, top: dict[str, Any], inner: dict[str, Any]) -> None:
    if not (tmp_path / "transforms.json").exists():
        nerfstudio(tmp_path, 3)
        (tmp_path / "kept.json").write_text((tmp_path / "transforms.json").read_text())
    document = json.loads((tmp_path / "kept.json").read_text())
    document["frames"][1].update(inner)
    document.update(top)
    write_json(tmp_path, document)
    try:
        for view in load_scene(tmp_path).train:
            view.pixels()
    except GsoptError as error:
        said = str(error)
    else:
        return
    assert said.count(". ") >= 1  # what and got, then what to do
