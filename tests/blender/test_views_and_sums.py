"""Views of datasets, where a rendered object lies, and the sums and filters over splats."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from made_splats import random_splats

from blender_addon.core import colmap, dataset, statistics
from blender_addon.core.cameras import read_views
from blender_addon.core.errors import GsoptError, InputError
from blender_addon.core.statistics import Filter, summary

POSE = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])


def frames(*names: object) -> list[dict[str, object]]:
    return [{"file_path": name, "transform_matrix": POSE.tolist()} for name in names]


def test_nerf_synthetic_views_have_pictures_without_suffix(odd_folder: Path) -> None:
    (odd_folder / "train").mkdir()
    (odd_folder / "train" / "r_0.png").touch()
    for split in ("train", "test"):
        document = {"camera_angle_x": 0.7, "frames": frames(f"./{split}/r_0")}
        (odd_folder / f"transforms_{split}.json").write_text(json.dumps(document))
    train, test = read_views(odd_folder)
    assert (train.image, train.split, test.split) == (odd_folder / "train" / "r_0.png", "train", "test")
    assert train.angle_x == 0.7
    assert np.array_equal(train.world_from_cam, POSE)
    assert train.shift == (0, 0)


def test_a_principal_point_becomes_a_shift(tmp_path: Path) -> None:
    lens = {"fl_x": 100.0, "w": 200, "h": 100, "cx": 90.0, "cy": 55.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames("a.png")}))
    (view,) = read_views(tmp_path)
    assert view.angle_x == pytest.approx(math.pi / 2)
    assert view.shift == pytest.approx((0.05, 0.025))


@pytest.mark.parametrize(
    ("model", "values"),
    [
        *((model, (100.0, 90.0, 55.0)) for model in (0, 2, 3, 8, 9)),  # one focal length: f, cx, cy
        *((model, (100.0, 101.0, 90.0, 55.0)) for model in (1, 4, 5, 6, 7, 10)),
    ],
)
def test_the_center_of_every_lens_of_colmap_is_read(tmp_path: Path, model: int, values: tuple[float, ...]) -> None:
    """Two cameras follow each other: the number of parameters is the model's too."""
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    padded = (*values, *[0.01] * (colmap.PARAMETERS[model] - len(values)))
    lenses = [struct.pack(f"<iiQQ{len(padded)}d", number, model, 200, 100, *padded) for number in (1, 2)]
    (sparse / "cameras.bin").write_bytes(struct.pack("<Q", 2) + b"".join(lenses))
    image = struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 2) + b"a.jpg\0" + struct.pack("<Q", 0)
    (sparse / "images.bin").write_bytes(struct.pack("<Q", 1) + image)
    (view,) = read_views(tmp_path)
    assert view.center == (90.0, 55.0)
    bad = struct.pack(f"<iiQQ{len(padded)}d", 2, model, 200, 100, values[0], *[math.nan] * (len(padded) - 1))
    (sparse / "cameras.bin").write_bytes(struct.pack("<Q", 1) + bad)
    with pytest.raises(InputError, match="no usable lens"):
        read_views(tmp_path)
    assert view.angle_x == pytest.approx(math.pi / 2)


def test_colmap_poses_are_inverted_and_turned(tmp_path: Path) -> None:
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    lens = struct.pack("<iiQQ4d", 1, 1, 200, 100, 100.0, 101.0, 90.0, 55.0)
    (sparse / "cameras.bin").write_bytes(struct.pack("<Q", 1) + lens)
    half = math.sqrt(0.5)
    head = struct.pack("<i7di", 1, half, 0, 0, half, 0.5, -1.0, 2.0, 1)
    images = struct.pack("<Q", 1) + head + b"a b.jpg\0" + struct.pack("<Q", 2) + bytes(48)
    (sparse / "images.bin").write_bytes(images)
    (view,) = read_views(tmp_path)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    world_from_cv = np.eye(4)
    world_from_cv[:3, :3], world_from_cv[:3, 3] = turn.T, -turn.T @ [0.5, -1.0, 2.0]
    assert np.allclose(view.world_from_cam, world_from_cv @ np.diag([1, -1, -1, 1]))
    assert (view.name, view.width, view.shift) == ("a b", 200, pytest.approx((0.05, 0.025)))
    for cut in range(0, len(images), 7):
        (sparse / "images.bin").write_bytes(images[:cut])
        with pytest.raises(InputError, match="COLMAP"):
            read_views(tmp_path)


HUGE = 10**400
LENS = {"w": 200, "h": 100, "cx": 90.0, "cy": 55.0, "fl_x": 100.0}


def test_a_name_that_no_file_system_has_is_a_picture_that_is_missing(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps({**LENS, "frames": frames("春" * 200)}))
    (view,) = read_views(tmp_path)
    assert view.image == tmp_path / ("春" * 200)


@pytest.mark.parametrize("entry", [HUGE, 1e300, math.inf, math.nan, "x", None, [1.0], 0.0])
def test_a_pose_of_the_object_that_cannot_be_used_is_refused(tmp_path: Path, entry: object) -> None:
    matrix = [*np.eye(4)[:3].tolist(), [0.0, 0.0, 0.0, entry]]
    for value in (matrix, entry):
        (tmp_path / dataset.RECORD).write_text(json.dumps({"normalized_from_mesh": value}))
        with pytest.raises(InputError, match=r"object\.json"):
            dataset.scene_from_dataset(tmp_path)


@pytest.mark.parametrize("reasons", ["[" * 500 + "]" * 500, "{}", "[3]", '[{"reason": "\\ud800"}]', "1e999", "[[[]]]"])
def test_reasons_that_are_none_end_no_poll(tmp_path: Path, reasons: str) -> None:
    (tmp_path / "failures.json").write_text(reasons)
    str(GsoptError(dataset.failure(tmp_path))).encode()


@pytest.mark.parametrize(
    "document",
    [
        {},
        {"frames": 3},
        {"frames": [3]},
        {"frames": frames("a")},
        {"camera_angle_x": 0.7, "frames": [{"file_path": "a"}]},
        {"camera_angle_x": 9.0, "frames": frames("a")},
        {"camera_angle_x": "x", "frames": frames("a")},
        {"camera_angle_x": 0.7, "frames": [{"file_path": "a", "transform_matrix": [[math.nan] * 4] * 4}]},
        {"camera_angle_x": 0.7, "frames": [{"file_path": "a", "transform_matrix": [[HUGE] * 4] * 4}]},
        *({"camera_angle_x": 0.7, "frames": frames(name)} for name in ("a\0b", "\ud800", True)),
        *({**LENS, key: HUGE, "frames": frames("a")} for key in LENS),
        *({**LENS, key: -1, "camera_angle_x": 0.7, "frames": frames("a")} for key in ("w", "h")),
        *({**LENS, key: math.inf, "frames": frames("a")} for key in ("cx", "cy")),
    ],
)
def test_views_that_cannot_be_used_are_refused_by_name(tmp_path: Path, document: object) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_views(tmp_path)


def test_pictures_are_counted_while_they_are_made(tmp_path: Path) -> None:
    assert dataset.pictures(tmp_path / "gone") == 0
    images = tmp_path / ".partial-1-ball" / "images"
    images.mkdir(parents=True)
    for name in ("a.png", "b.png", "c.tmp"):
        (images / name).touch()
    assert dataset.pictures(tmp_path) == 2
    assert dataset.finished(tmp_path) is None
    (tmp_path / "ball").mkdir()
    forward = np.diag([2.0, 2.0, 2.0, 1.0])
    forward[:3, 3] = 1, 2, 3
    (tmp_path / "ball" / dataset.RECORD).write_text(json.dumps({"normalized_from_mesh": forward.tolist()}))
    assert dataset.finished(tmp_path) == tmp_path / "ball"
    back = dataset.scene_from_dataset(tmp_path / "ball")
    assert back is not None
    assert np.allclose(back @ forward, np.eye(4))
    assert dataset.scene_from_dataset(tmp_path) is None


def test_histograms_count_every_splat_and_outliers_are_found() -> None:
    splats = random_splats(1000)
    splats.positions[3] = 1e4
    splats.scales[4] = 50
    found = summary(splats)
    assert sum(bar.count for bar in found.opacities) == sum(bar.count for bar in found.sizes) == found.count == 1000
    assert found.outliers == 2
    assert summary(splats.rows(slice(0, 0))).count == 0


def test_each_filter_keeps_what_it_says() -> None:
    splats = random_splats(1000)
    assert Filter().keeps(splats).all()
    assert np.array_equal(Filter(opacity=(0.5, 1)).keeps(splats), splats.opacities >= 0.5)
    assert np.array_equal(Filter(largest_scale=0.05).keeps(splats), splats.scales.max(axis=1) <= np.float32(0.05))
    distance = np.linalg.norm(splats.positions - (1, 0, 0), axis=1)
    for farthest in (0.5, 2.0):  # not 1, whose square is 1
        kept = Filter(farthest=farthest, center=(1, 0, 0)).keeps(splats)
        assert np.array_equal(kept, distance <= farthest)
        assert 0 < kept.sum() < 1000
    box = np.linalg.inv(np.array([[0.5, 0, 0, 1], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    inside = (np.abs(splats.positions - (1, 0, 0)) <= (0.5, 2, 1)).all(axis=1)
    assert np.array_equal(Filter(box_from_local=box).keeps(splats), inside)
    both = Filter(opacity=(0.5, 1), farthest=2.0).keeps(splats)
    assert np.array_equal(both, (splats.opacities >= 0.5) & (np.linalg.norm(splats.positions, axis=1) <= 2))


def test_outliers_are_found_among_more_splats_than_the_medians_look_at() -> None:
    splats = random_splats(statistics.SAMPLE + 1)
    splats.positions[3], splats.scales[4, 1], splats.positions[-1] = 1e4, 50, 1e30
    assert np.flatnonzero(statistics.outliers(splats)).tolist() == [3, 4, statistics.SAMPLE]


def test_at_most_never_shows_more_and_keeps_small_sets() -> None:
    splats = random_splats(1000)
    for most in (1, 7, 333, 999, 1000, 5000):
        assert 1 <= len(splats.at_most(most)) <= most
    assert splats.at_most(1000) is splats
