"""Files of mkkellogg's viewer, put together from their layout."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
import torch
from ksplat_files import ksplat
from splat_samples import make_splats

from gsopt.cli import main
from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("level", range(3))
def test_known_bytes_read_as_known_values(tmp_path: Path, level: int, degree: int) -> None:
    (tmp_path / "a.ksplat").write_bytes(ksplat(level, 5, degree))
    splats = load_splats(tmp_path / "a.ksplat")
    expected = torch.tensor([(i + 0.5, -i, 0.25) for i in range(5)])
    torch.testing.assert_close(splats.means, expected, atol=4 / 32767, rtol=0)
    assert splats.log_scales[0].tolist() == pytest.approx([-1, 0, 0], abs=1e-3)
    assert splats.quats[3].tolist() == [1, 0, 0, -1]
    assert splats.opacities.tolist() == pytest.approx([0.2] * 5)
    assert (splats.sh0[0, 0] * 0.28209479).tolist() == pytest.approx([0.5, -0.5, -0.3])
    assert splats.sh_degree == degree
    begin = 0
    for band in range(1, degree + 1):  # in a band all of red, then green, then blue
        width = 2 * band + 1
        values = (begin + torch.arange(3.0 * width).reshape(3, width).T) / 64
        rows = splats.shN[0, band * band - 1 : (band + 1) ** 2 - 1]
        torch.testing.assert_close(rows, values, atol=1.5 / 255 + 1e-3, rtol=0)
        begin += 3 * width


def test_it_can_be_exported_and_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "a.ksplat").write_bytes(ksplat(1, 5, 1))
    assert main(["export", str(tmp_path / "a.ksplat"), "-o", str(tmp_path / "a.ply")]) == 0
    with pytest.raises(InputError, match="must end in one of"):
        save_splats(tmp_path / "b.ksplat", make_splats(1))


@pytest.mark.parametrize(
    ("offset", "kind", "value", "message"),
    [
        (0, "B", 1, "must begin as"),
        (4, "I", 10**9, "sections"),
        (20, "H", 3, "level 3"),
        (4096, "I", 10**9, "claims 1000000000"),
        (4100, "I", 10**9, "before its last splat"),
        (4108, "I", 10**9, "before its last splat"),
        (4116, "H", 4, "before its last splat"),
        (4128, "I", 0, "fewer than"),
        (4136, "H", 4, "SH degree 4"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, offset: int, kind: str, value: int, message: str) -> None:
    data = bytearray(ksplat(1, 5, 1))
    struct.pack_into(f"<{kind}", data, offset, value)
    (tmp_path / "a.ksplat").write_bytes(bytes(data))
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "a.ksplat")


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = ksplat(1, 5, 1)
    for size in (*range(0, 5000, 501), *range(5120, len(data), 7)):
        (tmp_path / "a.ksplat").write_bytes(data[:size])
        with pytest.raises(InputError):
            load_splats(tmp_path / "a.ksplat")
    assert math.isfinite(float(load_splats_of(tmp_path, data)))


def load_splats_of(folder: Path, data: bytes) -> torch.Tensor:
    (folder / "whole.ksplat").write_bytes(data)
    return load_splats(folder / "whole.ksplat").means.sum()


@pytest.mark.parametrize("level", range(3))
def test_sections_follow_each_other_and_share_the_highest_degree(tmp_path: Path, level: int) -> None:
    one, two = ksplat(level, 5, 1), ksplat(level, 3, 2)
    header = bytearray(one[:4096])
    struct.pack_into("<I", header, 4, 2)
    (tmp_path / "a.ksplat").write_bytes(header + one[4096:5120] + two[4096:5120] + one[5120:] + two[5120:])
    (tmp_path / "one.ksplat").write_bytes(one)
    (tmp_path / "two.ksplat").write_bytes(two)
    found, first, last = (load_splats(tmp_path / f"{name}.ksplat") for name in ("a", "one", "two"))
    assert (len(found), found.sh_degree) == (8, 2)
    assert torch.equal(found.means, torch.cat([first.means, last.means]))
    assert torch.equal(found.shN[:5, :3], first.shN)
    assert torch.equal(found.shN[5:], last.shN)
    assert not found.shN[:5, 3:].any()


@pytest.mark.parametrize(
    ("offset", "kind", "value", "message"),
    [
        (1, "B", 0, "must begin as"),
        (1, "B", 2, None),
        (4, "I", 0, "holds no splats"),
        (20, "H", 2, None),
        (4096, "I", 6, "claims 6 of 5 splats"),
        (4112, "f", -1.0, "Damaged"),
        (4112, "f", math.nan, "Damaged"),
        (4112, "f", 1e30, "Damaged"),
        (4112, "f", 0.99e30, None),
        (4112, "f", 0.0, None),
    ],
)
def test_numbers_of_a_header_may_be_their_bounds(
    tmp_path: Path, offset: int, kind: str, value: float, message: str | None
) -> None:
    data = bytearray(ksplat(2, 5, 3))
    struct.pack_into(f"<{kind}", data, offset, value)
    (tmp_path / "a.ksplat").write_bytes(bytes(data))
    if message is None:
        assert len(load_splats(tmp_path / "a.ksplat")) == 5
    else:
        with pytest.raises(InputError, match=message):
            load_splats(tmp_path / "a.ksplat")
