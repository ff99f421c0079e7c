"""Known bytes of .splat and of PlayCanvas' compressed PLY, and files of both that lie."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from splat_samples import make_splats

from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats

C0 = 0.28209479177387814


def record(scale: float = 0.5, quat: bytes = bytes([128, 255, 128, 0])) -> bytes:
    return struct.pack("<6f", 1, 2, 3, scale, 1, 2) + bytes([255, 0, 51, 204]) + quat


def test_a_known_splat_reads_as_known_values(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(record())
    splats = load_splats(tmp_path / "a.splat")
    assert splats.means.tolist() == [[1, 2, 3]]
    assert splats.log_scales[0].tolist() == pytest.approx([math.log(0.5), 0, math.log(2)])
    assert splats.opacities.item() == pytest.approx(0.8)
    assert splats.sh0[0, 0].tolist() == pytest.approx([0.5 / C0, -0.5 / C0, -0.3 / C0], rel=1e-5)
    assert splats.quats.tolist() == [[0, 127 / 128, 0, -1]]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (record() + b"x", "no multiple"),
        (record() + record(scale=-1), "scale_0` of row 1"),
        (record() + record(scale=float("nan")), "scale_0` of row 1"),
        (record() + record(quat=bytes([128] * 4)), "row 1 has no usable length"),
    ],
)
def test_a_splat_that_lies_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "a.splat", strict=True)


def test_a_flat_splat_gets_the_least_scale(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(record(scale=0))
    assert -88 < load_splats(tmp_path / "a.splat").log_scales[0, 0] < -87


EXTREMES = [
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def write_compressed(
    path: Path, words: list[tuple[int, int, int, int]], *, colors: bool = True, chunks: int = 1, order: str = "<"
) -> None:
    names = EXTREMES if colors else EXTREMES[:12]
    chunk = np.zeros(chunks, [(name, "f4") for name in names])
    for name in names:
        chunk[name] = {"min": -1, "max": 3}[name[:3]]
    vertex = np.array(words, dtype=[(name, "u4") for name in PACKED])
    elements = [PlyElement.describe(chunk, "chunk"), PlyElement.describe(vertex, "vertex")]
    PlyData(elements, byte_order=order).write(path)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("colors", [True, False])
def test_known_words_read_as_known_values(tmp_path: Path, colors: bool, order: str) -> None:
    position = 2047 << 21 | 0 << 11 | 0
    scale = 0 << 21 | 1023 << 11 | 2047
    rotation = 2 << 30 | 1023 << 20 | 0  # the third, y, is the largest; w = sqrt(1/2) and x = z = -sqrt(1/2)
    color = 255 << 24 | 0 << 16 | 51 << 8 | 102
    write_compressed(tmp_path / "a.compressed.ply", [(position, rotation, scale, color)], colors=colors, order=order)
    splats = load_splats(tmp_path / "a.compressed.ply")
    assert splats.means.tolist() == [[3, -1, -1]]
    assert splats.log_scales.tolist() == [[-1, 3, 3]]
    assert splats.opacities.item() == pytest.approx(0.4)
    half = math.sqrt(0.5)
    assert splats.quats[0].tolist() == pytest.approx([half, -half, 0, -half])
    rgb = [3, -1, -0.2] if colors else [1, 0, 0.2]
    assert splats.sh0[0, 0].tolist() == pytest.approx([(v - 0.5) / C0 for v in rgb], rel=1e-5)


def test_the_harmonics_follow_the_words_of_the_reference(tmp_path: Path) -> None:
    """A byte b stands for 8 ((b + 0.5) / 256 - 0.5), 0 and 255 for the ends -4 and 4, channel by channel."""
    splats = make_splats(4, degree=1)
    path = tmp_path / "a.compressed.ply"
    save_splats(path, splats)
    ply = PlyData.read(path, mmap=False)
    table = np.array(ply["sh"].data)
    for i in range(9):
        table[f"f_rest_{i}"] = [0, 255, 128, 10 + i]
    PlyData([ply["chunk"], ply["vertex"], PlyElement.describe(table, "sh")], byte_order="<").write(path)
    shN = load_splats(path).shN
    assert shN[:3, 0, 0].tolist() == [-4, 4, 8 * 0.5 / 256]
    expected = [[8 * ((10 + 3 * channel + band + 0.5) / 256 - 0.5) for channel in range(3)] for band in range(3)]
    np.testing.assert_allclose(shN[3], expected, atol=1e-6)


def test_the_header_is_playcanvas_header(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.compressed.ply", make_splats(300, degree=1))
    ply = PlyData.read(tmp_path / "a.compressed.ply")
    assert [(element.name, element.count) for element in ply.elements] == [("chunk", 2), ("vertex", 300), ("sh", 300)]
    assert [p.name for p in ply["chunk"].properties] == EXTREMES
    assert [p.name for p in ply["vertex"].properties] == PACKED
    assert [p.name for p in ply["sh"].properties] == [f"f_rest_{i}" for i in range(9)]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"chunk 2", b"chunk 1", "1 chunks for 300 splats"),
        (b"vertex 300", b"vertex 9999999999", "chunks for"),
        (b"chunk 2", b"chunk 9999999999", "chunks for"),
        (b"sh 300", b"sh 299", "299 rows"),
        (b"property uint packed_color\n", b"", "packed_color"),
        (b"uint packed_scale", b"int packed_scale", "packed_scale"),
        (b"property float max_b\n", b"", "extremes"),
        (b"property uchar f_rest_8\n", b"", "8 f_rest"),
        (b"binary_little_endian", b"ascii", "is text"),
    ],
)
def test_a_compressed_header_that_lies_is_refused(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = tmp_path / "a.compressed.ply"
    save_splats(path, make_splats(300, degree=1))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_splats(path)


def test_chunks_that_are_not_finite_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    save_splats(path, make_splats(300, degree=0))
    ply = PlyData.read(path, mmap=False)
    ply["chunk"].data["max_z"][1] = np.nan
    ply.write(path)
    with pytest.raises(InputError, match="`z` of row 256"):
        load_splats(path, strict=True)
