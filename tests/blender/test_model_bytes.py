"""COLMAP's models and .spz files byte by byte, as the extension reads them without COLMAP and without gsopt."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from blender_addon.core import colmap, spz
from blender_addon.core.errors import InputError
from blender_addon.core.splats import Splats

MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "FOV": (7, "fx fy cx cy omega"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
}
"""COLMAP's documentation: the number of each model, and its parameters in order."""
VALUES = {"f": 500.0, "fx": 500.0, "fy": 600.0, "cx": 31.0, "cy": 17.0}


def cameras(number: int, parameters: str, width: int = 64, height: int = 48) -> bytes:
    """Two cameras of one model."""
    values = [VALUES.get(name, 0.25) for name in parameters.split()]
    rows = (struct.pack(f"<iiQQ{len(values)}d", camera, number, width, height, *values) for camera in (7, 9))
    return struct.pack("<Q", 2) + b"".join(rows)


@pytest.mark.parametrize("model", MODELS)
def test_a_camera_of_any_model_has_its_focal_length_and_center_and_ends_after_its_parameters(model: str) -> None:
    found = colmap.read_cameras(cameras(*MODELS[model]))
    assert found == {7: (64, 48, 500.0, (31.0, 17.0)), 9: (64, 48, 500.0, (31.0, 17.0))}


@pytest.mark.parametrize("size", [0, 2**31])
def test_a_camera_without_a_size_that_a_property_holds_is_refused(size: int) -> None:
    for width, height in ((size, 48), (64, size)):
        with pytest.raises(ValueError, match="no usable lens"):
            colmap.read_cameras(cameras(*MODELS["PINHOLE"], width=width, height=height))
    assert len(colmap.read_cameras(cameras(*MODELS["PINHOLE"], width=1, height=2**31 - 1))) == 2


def image(name: str, pose: tuple[float, ...], camera: int, points: int) -> bytes:
    head = struct.pack("<i7di", 3, *pose, camera)
    return head + name.encode() + b"\0" + struct.pack("<Q", points) + b"\1" * 24 * points


def test_pictures_have_their_poses_lenses_and_names_whatever_points_they_see() -> None:
    """A quaternion of length 2 about z by 90 degrees takes x to y; the translation stays as it is."""
    half = math.sqrt(2)
    rows = [image("a.png", (half, 0, 0, half, 1, 2, 3), 5, 3), image("b/ä.jpg", (1, 0, 0, 0, 4, 5, 6), 6, 0)]
    lenses = {5: (64, 48, 500.0, (31.0, 17.0)), 6: (10, 20, 30.0, (5.0, 6.0))}
    first, second = colmap.read_images(struct.pack("<Q", 2) + b"".join(rows), lenses)
    turned = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(first.cam_from_world, turned, atol=1e-12)
    np.testing.assert_allclose(second.cam_from_world, [[1, 0, 0, 4], [0, 1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]])
    assert (first.name, first.width, first.height, first.focal, first.center) == ("a.png", 64, 48, 500, (31, 17))
    assert (second.name, second.width, second.focal) == ("b/ä.jpg", 10, 30)


@pytest.mark.parametrize("cut", [1, 24, 73])
def test_pictures_that_are_cut_short_are_refused(cut: int, tmp_path: Path) -> None:
    data = struct.pack("<Q", 1) + image("a.png", (1, 0, 0, 0, 0, 0, 0), 7, 3)
    (tmp_path / "cameras.bin").write_bytes(cameras(*MODELS["PINHOLE"]))
    (tmp_path / "images.bin").write_bytes(data)
    assert [picture.name for picture in colmap.read_pictures(tmp_path)] == ["a.png"]
    (tmp_path / "images.bin").write_bytes(data[:-cut])
    with pytest.raises(InputError, match="cannot be read"):
        colmap.read_pictures(tmp_path)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_about_an_axis_turns_the_other_two(axis: int) -> None:
    angle = 0.7
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    expected = np.eye(4)
    b, c = (axis + 1) % 3, (axis + 2) % 3
    expected[b, b] = expected[c, c] = math.cos(angle)
    expected[b, c], expected[c, b] = -math.sin(angle), math.sin(angle)
    np.testing.assert_allclose(colmap.rigid(3 * quaternion, np.zeros(3)), expected, atol=1e-12)


def packed(version: int, degree: int, body: bytes, count: int = 1, fraction: int = 4, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, fraction, flags, 0) + body)


def one_splat(version: int, rotation: bytes, degree: int = 0, rest: bytes = b"") -> bytes:
    """At (1.5, -0.25, 2), with a middle opacity, gray, of scale e^-2."""
    points = bytes([24, 0, 0, 252, 255, 255, 32, 0, 0])
    return packed(version, degree, points + bytes([128]) + bytes([128] * 3) + bytes([128] * 3) + rotation + rest)


def read(folder: Path, data: bytes) -> Splats:
    path = folder / "a.spz"
    path.write_bytes(data)
    return spz.read_spz(path)


def test_a_splat_of_an_spz_reads_as_its_codes_say(tmp_path: Path) -> None:
    """Positions count 16ths here; up and back become down and forward. Log-scales are 16ths less 10."""
    for version, rotation in ((2, bytes([128, 128, 255])), (3, struct.pack("<I", 2 << 30))):
        found = read(tmp_path, one_splat(version, rotation))
        assert found.positions.tolist() == [[1.5, 0.25, -2.0]]
        np.testing.assert_allclose(found.base, np.full((1, 3), (128 / 255 - 0.5) / 0.15), atol=1e-6)
        np.testing.assert_allclose(found.scales, np.full((1, 3), math.exp(-2)), rtol=1e-6)
        np.testing.assert_allclose(found.opacities, [128 / 255], rtol=1e-6)
        assert found.sh.shape == (1, 0, 3)
        assert np.abs(found.rotations[0] @ [0, 0, 0, 1]) == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("degree", "bands"), [(1, 3), (2, 8), (3, 15)])
def test_harmonics_of_an_spz_are_128ths_around_128_color_fastest(degree: int, bands: int, tmp_path: Path) -> None:
    """Turned by half a circle about x, those that are odd in y or z change their signs."""
    codes = np.arange(3 * bands, dtype=np.uint8) * 5
    found = read(tmp_path, one_splat(3, struct.pack("<I", 3 << 30), degree, codes.tobytes()))
    np.testing.assert_allclose(np.abs(found.sh.ravel()), np.abs(codes.astype(float) - 128) / 128, atol=1e-6)
    assert found.sh[0, 2, 0] == (int(codes[6]) - 128) / 128  # of x, which stays
    assert found.sh[0, 0, 0] == -(int(codes[0]) - 128) / 128  # of y, which turns around


@pytest.mark.parametrize(("code", "wxyz"), [(0, [0, 1, 0, 0]), (1, [0, 0, 1, 0]), (2, [0, 0, 0, 1]), (3, [1, 0, 0, 0])])
def test_two_bits_name_the_largest_component_of_a_rotation(code: int, wxyz: list[float]) -> None:
    codes = np.array([code << 30], "<u4").view(np.uint8)
    assert spz.smallest_three(codes).tolist() == [wxyz]


def test_the_smaller_components_of_a_rotation_have_a_sign_and_nine_bits_of_the_root_of_a_half() -> None:
    """0.6 is 434 of 511 steps; the first of the others stands highest."""
    word = 3 << 30 | (512 | 434) << 20
    np.testing.assert_allclose(
        spz.smallest_three(np.array([word], "<u4").view(np.uint8)), [[0.8, -0.6, 0, 0]], atol=1e-3
    )
    word = 0 << 30 | 434
    np.testing.assert_allclose(
        spz.smallest_three(np.array([word], "<u4").view(np.uint8)), [[0.6, 0.8, 0, 0]], atol=1e-3
    )


@pytest.mark.parametrize(
    ("changed", "refused"),
    [
        ({"version": 1}, True),
        ({"version": 4}, True),
        ({"degree": 4}, True),
        ({"fraction": 23}, False),
        ({"fraction": 24}, True),
        ({"flags": 1}, False),
        ({"flags": 2}, True),
        ({"count": 2}, True),
    ],
)
def test_an_spz_header_says_what_is_known_here(changed: dict[str, int], refused: bool, tmp_path: Path) -> None:
    given = {"version": 3, "degree": 0, "count": 1, "fraction": 4, "flags": 0, **changed}
    body = bytes(9 + 1 + 3) + bytes([128] * 3) + struct.pack("<I", 3 << 30)
    data = packed(body=body, **given)
    if refused:
        with pytest.raises(InputError):
            read(tmp_path, data)
    else:
        assert len(read(tmp_path, data)) == 1


def body_of(count: int, alpha: int = 128) -> bytes:
    """Equal splats at the origin, turned nowhere."""
    streams = (bytes(9), bytes([alpha]), bytes([128] * 3), bytes([128] * 3), struct.pack("<I", 3 << 30))
    return b"".join(stream * count for stream in streams)


@pytest.mark.parametrize(("alpha", "opacity"), [(0, 0.25 / 255), (1, 1 / 255), (254, 254 / 255), (255, 1 - 0.25 / 255)])
def test_the_ends_of_opacity_stay_a_quarter_of_a_step_within(alpha: int, opacity: float, tmp_path: Path) -> None:
    found = read(tmp_path, packed(3, 0, body_of(1, alpha)))
    assert found.opacities[0] == pytest.approx(opacity, rel=1e-3)
    assert 1 - found.opacities[0] == pytest.approx(1 - opacity, rel=1e-3)


@pytest.mark.parametrize(
    ("always", "ratio", "refused"), [(20_000, 0, False), (19_999, 0, True), (0, 1000, False), (0, 50, True)]
)
def test_a_file_unpacks_to_so_many_bytes_or_to_so_many_times_its_size(
    always: int, ratio: int, refused: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousand splats of 20 bytes each, packed into less than 200: a hundred times."""
    data = packed(3, 0, body_of(1000), count=1000)
    assert 20 < len(data) < 200
    monkeypatch.setattr(spz, "ALWAYS", always)
    monkeypatch.setattr(spz, "RATIO", ratio)
    if refused:
        with pytest.raises(InputError, match="claims 1,000 splats"):
            read(tmp_path, data)
    else:
        assert len(read(tmp_path, data)) == 1000


def test_progress_is_the_share_of_the_file_that_was_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It rises in steps of a piece, from above 0 to 1."""
    path = tmp_path / "a.spz"
    path.write_bytes(packed(3, 0, body_of(1000), count=1000))
    size = path.stat().st_size
    shares: list[float] = []
    monkeypatch.setattr(spz, "PIECE", 50)
    spz.read_spz(path, shares.append)
    assert shares == sorted(shares)
    assert set(shares) <= {*(50 * i / size for i in range(1, 1 + size // 50)), 1.0}
    assert shares[0] == pytest.approx(50 / size)
    assert shares[-1] > 0.5
