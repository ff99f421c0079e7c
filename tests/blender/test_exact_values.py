"""Numbers that the panel shows and reads, against independent formulas, and its limits met exactly."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hamilton import POINTS, QUATERNIONS, turned
from hypothesis import given
from made_splats import random_splats

from blender_addon.core import cameras, colmap, files, ply, splats, units
from blender_addon.core.errors import InputError
from blender_addon.core.harmonics import C0, HARMONICS
from blender_addon.core.statistics import Filter, bars, outliers, summary

UNIT = np.eye(4).tolist()


@given(QUATERNIONS, POINTS)
def test_a_quaternion_turns_a_point_as_hamiltons_product_does(quaternion: list[float], point: list[float]) -> None:
    matrix = colmap.rigid(np.array(quaternion), np.array(point))
    assert np.allclose(matrix[:3, :3] @ point, turned(quaternion, point), atol=1e-9)
    assert matrix[:3, 3].tolist() == point
    assert matrix[3].tolist() == [0, 0, 0, 1]


def lens(width: int, height: int, focal: float, center: float = 3.0) -> bytes:
    return struct.pack("<Q", 1) + struct.pack("<iiQQ3d", 1, 0, width, height, focal, center, 4.0)


@pytest.mark.parametrize(
    "values", [(0, 5, 9.0), (5, 0, 9.0), (2**31, 5, 9.0), (5, 2**31, 9.0), (5, 5, 0.0), (5, 5, -1.0)]
)
def test_a_lens_without_a_size_or_a_focal_length_is_refused(values: tuple[int, int, float]) -> None:
    with pytest.raises(ValueError, match="camera 1 has no usable lens"):
        colmap.read_cameras(lens(*values))
    with pytest.raises(ValueError, match="no usable lens"):
        colmap.read_cameras(lens(5, 5, 9.0, math.inf))


@pytest.mark.parametrize("size", [(1, 1), (2**31 - 1, 2**31 - 1), (1, 2**31 - 1)])
def test_a_lens_of_any_size_that_blender_holds_is_read(size: tuple[int, int]) -> None:
    assert colmap.read_cameras(lens(*size, 1e-3)) == {1: (*size, 1e-3, (3.0, 4.0))}


def test_a_model_names_several_pictures_and_says_where_it_ends() -> None:
    one = {7: (4, 3, 2.0, (2.0, 1.5))}
    head = [struct.pack("<i7di", i, 1, 0, 0, 0, i, 0, 0, 7) for i in (1, 2)]
    whole = head[0] + b"a\0" + struct.pack("<Q", 2) + bytes(48) + head[1] + b"b\0" + struct.pack("<Q", 0)
    found = colmap.read_images(struct.pack("<Q", 2) + whole, one)
    assert [(picture.name, picture.cam_from_world[0, 3]) for picture in found] == [("a", 1.0), ("b", 2.0)]
    assert [picture.name for picture in colmap.read_images(struct.pack("<Q", 1) + whole, one)] == ["a"]
    with pytest.raises(ValueError, match=r"images\.bin ends within b"):
        colmap.read_images(struct.pack("<Q", 2) + whole[:-8] + struct.pack("<Q", 1) + bytes(23), one)
    assert len(colmap.read_images(struct.pack("<Q", 2) + whole[:-8] + struct.pack("<Q", 1) + bytes(24), one)) == 2


def test_files_of_exactly_the_largest_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": 1}')
    monkeypatch.setattr(colmap, "LARGEST_FILE", 8)
    assert colmap.load(path) == path.read_bytes()
    assert files.read_json(path, 8) == {"a": 1}
    monkeypatch.setattr(colmap, "LARGEST_FILE", 7)
    with pytest.raises(ValueError, match="larger than 7 bytes"):
        colmap.load(path)
    with pytest.raises(InputError, match="larger than 7 bytes"):
        files.read_json(path, 7)


def view(tmp_path: Path, **changed: Any) -> cameras.View:
    frame = {"file_path": "a", "transform_matrix": UNIT, "camera_angle_x": 0.7, **changed}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    (found,) = cameras.read_views(tmp_path)
    return found


def test_the_field_of_view_follows_from_focal_length_and_width_where_both_are_there(tmp_path: Path) -> None:
    assert view(tmp_path, w=200, h=100, fl_x=100.0).angle_x == pytest.approx(math.pi / 2)
    assert view(tmp_path, fl_x=100.0).angle_x == 0.7
    assert view(tmp_path, w=200, h=100, fl_x=0.0).angle_x == 0.7
    assert view(tmp_path, w=1, h=1, fl_x=0.25).angle_x == pytest.approx(2 * math.atan(2))
    assert view(tmp_path, camera_angle_x=3.14).angle_x == 3.14
    for angle in (0.0, math.pi, -0.1):
        with pytest.raises(InputError, match="field of view"):
            view(tmp_path, camera_angle_x=angle)


def test_a_principal_point_needs_a_size_and_shifts_by_widths(tmp_path: Path) -> None:
    """Right and down of the middle: Blender's shift is negative to the left, positive upwards."""
    shifted = view(tmp_path, w=200, h=100, cx=110.0, cy=70.0)
    assert shifted.center == (110.0, 70.0)
    assert shifted.shift == pytest.approx((-0.05, 0.1))
    assert view(tmp_path, cx=110.0, cy=70.0).shift == (0.0, 0.0)
    assert view(tmp_path, w=0, h=0, cx=1.0, cy=2.0).shift == (0.0, 0.0)
    for broken in ({"cx": math.nan, "cy": 1.0}, {"cx": 1.0, "cy": math.inf}):
        with pytest.raises(InputError, match="cx or cy"):
            view(tmp_path, w=2, h=2, **broken)


def test_poses_of_three_rows_get_their_fourth(tmp_path: Path) -> None:
    assert view(tmp_path, transform_matrix=[[0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6]]).world_from_cam.tolist() == [
        [0, -1, 0, 4],
        [1, 0, 0, 5],
        [0, 0, 1, 6],
        [0, 0, 0, 1],
    ]
    for broken in (UNIT[:2], [*UNIT, [0] * 4], [row[:3] for row in UNIT]):
        with pytest.raises(InputError, match="no 4x4 matrix"):
            view(tmp_path, transform_matrix=broken)


@pytest.mark.parametrize(("size", "fine"), [(0, True), (2**31 - 1, True), (-1, False), (2**31, False)])
def test_sizes_that_no_property_holds_are_refused(tmp_path: Path, size: int, fine: bool) -> None:
    for name, other in (("w", "h"), ("h", "w")):
        if fine:
            found = view(tmp_path, **{name: size, other: 5})
            assert {found.width, found.height} == {size, 5}
        else:
            with pytest.raises(InputError, match="w, h or file_path"):
                view(tmp_path, **{name: size, other: 5})


def test_as_many_frames_as_are_allowed_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = {"file_path": "a", "transform_matrix": UNIT}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame] * 3}))
    monkeypatch.setattr(cameras, "MOST_VIEWS", 3)
    assert len(cameras.read_views(tmp_path)) == 3
    monkeypatch.setattr(cameras, "MOST_VIEWS", 2)
    with pytest.raises(InputError, match="at most 2 views"):
        cameras.read_views(tmp_path)


def test_an_outlier_is_six_median_distances_out_or_twenty_median_sizes_large() -> None:
    line = random_splats(9)
    line.positions[:] = 0
    line.positions[:, 0] = [-2, -1, -1, -1, 0, 1, 1, 1, 2]
    line.scales[:] = 0.5
    assert outliers(line).sum() == 0
    for distance, expected in ((6.0, False), (6.01, True)):
        line.positions[8, 0] = distance
        assert outliers(line)[8] == expected
    line.positions[8, 0] = 2
    for axis, (size, expected) in enumerate(((10.0, False), (10.01, True), (11.0, True))):
        line.scales[8] = 0.5
        line.scales[8, axis] = size
        assert outliers(line)[8] == expected
        assert outliers(line)[:8].sum() == 0
        assert np.array_equal(Filter(without_outliers=True).keeps(line), ~outliers(line))


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3, 1e6])
def test_outliers_do_not_depend_on_the_unit_of_the_scene(unit: float) -> None:
    cloud = random_splats(200)
    cloud.positions[:20] *= 50
    cloud.scales[20:40] *= 200
    in_scene_units = outliers(cloud)
    assert 20 < in_scene_units.sum() < 60
    cloud.positions[:] *= unit
    cloud.scales[:] *= unit
    assert np.array_equal(outliers(cloud), in_scene_units)


def test_a_summary_is_that_of_numpy() -> None:
    cloud = replace(random_splats(1000), left_out=3)
    found = summary(cloud)
    size = np.exp(np.log(cloud.scales.astype(float)).mean(axis=1))
    assert found.median_size == pytest.approx(float(np.median(size)), rel=1e-5)
    assert (found.low, found.high) == (tuple(cloud.positions.min(0).tolist()), tuple(cloud.positions.max(0).tolist()))
    assert (found.sh_degree, found.left_out, found.count) == (3, 3, 1000)
    assert [round(bar.low, 6) for bar in found.opacities] == [round(i / 10, 6) for i in range(10)]
    assert [bar.count for bar in found.opacities] == np.histogram(cloud.opacities, 10, (0, 1))[0].tolist()
    low, high = np.quantile(size, (0.001, 0.999))
    assert found.sizes[0].low == pytest.approx(low, rel=1e-3)
    assert found.sizes[-1].high == pytest.approx(high, rel=1e-3)
    steps = [bar.high / bar.low for bar in found.sizes]
    assert steps == pytest.approx([(high / low) ** 0.1] * 10, rel=1e-3)
    one = summary(cloud.rows(slice(0, 1)))
    assert (one.count, sum(bar.count for bar in one.sizes), one.outliers) == (1, 1, 0)
    assert one.sizes[-1].high == pytest.approx(one.sizes[0].low * 10**0.01)
    none = summary(cloud.rows(slice(0, 0)))
    assert (none.low, none.high, none.median_size, none.opacities, none.outliers) == ((0, 0, 0), (0, 0, 0), 0.0, (), 0)


def test_the_limits_of_a_filter_are_kept_themselves() -> None:
    three = random_splats(3)
    three.opacities[:] = [0.25, 0.5, 0.75]
    three.scales[:] = np.array([[1, 0.5, 0.25], [0.25, 2, 0.5], [0.5, 0.25, 4]])
    three.positions[:] = [[3, 0, 0], [0, -2, 0], [0, 0, 1]]
    assert Filter(opacity=(0.5, 0.75)).keeps(three).tolist() == [False, True, True]
    assert Filter(opacity=(0.25, 0.5)).keeps(three).tolist() == [True, True, False]
    assert Filter(largest_scale=2.0).keeps(three).tolist() == [True, True, False]
    assert Filter(farthest=2.0).keeps(three).tolist() == [False, True, True]
    assert Filter(box_from_local=np.diag([1 / 3, 0.5, 1, 1])).keeps(three).tolist() == [True, True, True]
    assert Filter(box_from_local=np.diag([0.5, 0.5, 1, 1])).keeps(three).tolist() == [False, True, True]


def test_bars_count_between_their_edges() -> None:
    found = bars(np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0]), np.array([0.0, 1.0, 2.0]))
    assert [(bar.low, bar.high, bar.count) for bar in found] == [(0.0, 1.0, 2), (1.0, 2.0, 3)]


def test_activated_values_are_those_of_the_formulas() -> None:
    random = np.random.default_rng(5)
    rows = [
        random.normal(size=shape).astype(np.float32)
        for shape in ((20, 3), (20, 3), (20, 4), (20,), (20, 3), (20, 3, 3))
    ]
    found = splats.from_file_values(*rows, path="a.ply")
    assert np.allclose(found.scales, np.exp(rows[1]), rtol=1e-6)
    assert np.allclose(found.opacities, 1 / (1 + np.exp(-rows[3].astype(float))), rtol=1e-6)
    assert np.allclose(found.rotations * np.linalg.norm(rows[2], axis=1)[:, None], rows[2], rtol=1e-5)
    assert np.allclose(splats.log_scales(found), rows[1], atol=1e-5)
    assert np.allclose(splats.logits(found), rows[3], atol=1e-4)
    assert np.allclose(found.colors, np.clip(0.5 + 0.28209479177387814 * rows[4], 0, 1), atol=1e-6)
    assert found.left_out == 0
    for part in (0, 1, 4, 5):
        broken = [values.copy() for values in rows]
        broken[part][3] = np.nan
        left = splats.from_file_values(*broken, path="a.ply")
        assert (len(left), left.left_out) == (19, 1)
        assert np.array_equal(left.positions, np.delete(rows[0], 3, axis=0))
    rows[2][7] = 0
    rows[3][8], rows[1][9] = np.inf, [200, -200, 0]
    left = splats.from_file_values(*rows, path="a.ply")
    assert (len(left), left.left_out, left.opacities[7]) == (19, 1, 1.0)
    assert left.scales[8].tolist() == np.exp(np.float32([87, -87, 0])).tolist()
    with pytest.raises(InputError, match="got 20 with NaN"):
        splats.from_file_values(rows[0] * np.nan, *rows[1:], path="a.ply")


def test_at_most_takes_every_kth_row() -> None:
    cloud = random_splats(10)
    assert np.array_equal(cloud.at_most(4).positions, cloud.positions[::3])
    assert np.array_equal(cloud.at_most(5).positions, cloud.positions[::2])
    assert np.array_equal(cloud.at_most(9).positions, cloud.positions[::2])
    assert len(cloud.at_most(0)) == 1


@pytest.mark.parametrize(
    ("note", "scale"),
    [(2.5, 2.5), ("0.5", 0.5), (0, 1.0), (-1, 1.0), (math.inf, 1.0), (math.nan, 1.0), (None, 1.0), ([], 1.0)],
)
def test_a_scale_is_a_finite_number_above_zero(tmp_path: Path, note: object, scale: float) -> None:
    assert units.usable(note) == scale
    (tmp_path / "units.json").write_text(json.dumps({"meters_per_unit": note}))
    assert units.meters_per_unit(tmp_path) == scale
    assert units.meters_per_unit(tmp_path / "splat.ply") == scale


def test_the_scale_of_a_ply_stands_in_its_header(tmp_path: Path) -> None:
    path = tmp_path / "a.PLY"
    path.write_bytes(b"ply\ncomment Meters per unit: 0.25\r\nend_header\ncomment meters per unit: 9\n")
    assert units.meters_per_unit(path) == 0.25
    path.write_bytes(b"ply\nend_header\ncomment meters per unit: 9\n")
    assert units.meters_per_unit(path) == 1.0
    assert units.meters_per_unit(tmp_path / "absent.ply") == 1.0
    path.rename(tmp_path / "a.spz")
    assert units.meters_per_unit(tmp_path / "a.spz") == 1.0


@pytest.mark.parametrize("block", [1, 3, 10, 64])
def test_a_ply_is_the_same_whatever_the_size_of_its_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    cloud, shares = random_splats(10, bands=8), list[float]()
    ply.write_ply(tmp_path / "whole.ply", cloud)
    monkeypatch.setattr(ply, "BLOCK", block)
    ply.write_ply(tmp_path / "blocks.ply", cloud, progress=shares.append)
    assert (tmp_path / "blocks.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    expected = [min(1.0, (i + 1) * block / 10) for i in range(-(-10 // block))]
    assert shares == pytest.approx(expected)
    shares.clear()
    found = ply.read_ply(tmp_path / "whole.ply", shares.append)
    assert shares == pytest.approx(expected)
    for name in ("positions", "scales", "rotations", "opacities", "base", "sh"):
        np.testing.assert_allclose(getattr(found, name), getattr(cloud, name), rtol=1e-5, atol=1e-6)
    data = (tmp_path / "whole.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[:-1])
    with pytest.raises(InputError, match="claims 10 rows of `vertex`"):
        ply.read_ply(tmp_path / "cut.ply")


def test_harmonics_are_those_of_the_published_splats() -> None:
    """The basis of Kerbl et al. 2023 with the constants of their code, at directions on the unit sphere."""
    directions = np.random.default_rng(4).normal(size=(20, 3))
    x, y, z = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    a, b, c = 0.48860251190291987, 1.0925484305920792, 0.31539156525252005
    d, e, f, g = 0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154
    second = [b * x * y, -b * y * z, c * (2 * z * z - x * x - y * y), -b * x * z, b / 2 * (x * x - y * y)]
    third = [-d * y * (3 * x * x - y * y), e * x * y * z, -f * y * (4 * z * z - x * x - y * y)]
    third += [g * z * (2 * z * z - 3 * x * x - 3 * y * y), -f * x * (4 * z * z - x * x - y * y)]
    third += [e / 2 * z * (x * x - y * y), -d * x * (x * x - 3 * y * y)]
    expected = {1: [-a * y, a * z, -a * x], 2: second, 3: third}
    assert list(HARMONICS) == [1, 2, 3]
    assert pytest.approx(0.28209479177387814, rel=1e-14) == C0
    for degree, harmonics in HARMONICS.items():
        np.testing.assert_allclose(harmonics(x, y, z), expected[degree], rtol=0, atol=1e-12)
