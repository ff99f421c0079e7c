"""Extension records and degree 4 of .spz, as the reference treats them."""

from __future__ import annotations

import gzip
import struct
import warnings
from pathlib import Path

import pytest
import torch
from splat_samples import make_splats, same_bits

from gsopt.errors import InputError, InputWarning
from gsopt.formats import load_splats
from gsopt.formats.spz import save_spz
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh

ORBIT, FRAME = 0xADBE0002, 0xADBE0003
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
FRAMES = (
    *("RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU"),
)


def record(kind: int, payload: bytes) -> bytes:
    return struct.pack("<II", kind, len(payload)) + payload


def with_records(folder: Path, version: int, records: bytes, splats: Gaussians) -> Path:
    """A file that carries extension records: behind the streams of version 3, before the table of version 4."""
    path = folder / f"{version}.spz"
    save_spz(path, splats, version=version)
    if version == 3:
        plain = bytearray(gzip.decompress(path.read_bytes()))
        plain[14] |= 2
        path.write_bytes(gzip.compress(bytes(plain) + records, 1))
    else:
        data = bytearray(path.read_bytes())
        data[14] |= 2
        struct.pack_into("<I", data, 16, 32 + len(records))
        path.write_bytes(bytes(data[:32]) + records + bytes(data[32:]))
    return path


@pytest.fixture(params=[3, 4])
def version(request: pytest.FixtureRequest) -> int:
    if request.param == 4:
        pytest.importorskip("zstandard")
    return int(request.param)


def plain(folder: Path, splats: Gaussians) -> Gaussians:
    save_spz(folder / "plain.spz", splats)
    return load_splats(folder / "plain.spz")


def test_unknown_records_are_skipped_with_one_warning(tmp_path: Path, version: int) -> None:
    records = record(ORBIT, bytes(12)) + record(0x12340001, b"xyz") + record(0x12340001, b"") + record(7, bytes(9))
    path = with_records(tmp_path, version, records, make_splats(5))
    with pytest.warns(InputWarning, match="0x12340001, 0x00000007") as caught:
        splats = load_splats(path)
    assert len(caught) == 1
    assert same_bits(splats, plain(tmp_path, make_splats(5)))


def test_the_orbit_of_a_camera_changes_nothing(tmp_path: Path, version: int) -> None:
    path = with_records(tmp_path, version, record(ORBIT, bytes(12)), make_splats(5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert same_bits(load_splats(path), plain(tmp_path, make_splats(5)))


@pytest.mark.parametrize("number", range(17))
def test_a_record_names_the_axes_of_the_file(tmp_path: Path, number: int) -> None:
    """The stored numbers are the same; what they mean follows the letters, also for the colors."""
    splats = make_splats(20)
    path = with_records(tmp_path, 3, record(FRAME, struct.pack("<I", number)), splats)
    usual, named = plain(tmp_path, splats), load_splats(path)
    ply_from_named = torch.tensor([DIRECTIONS[letter] for letter in FRAMES[number]], dtype=torch.float32).T
    named_from_ply = ply_from_named @ torch.diag(torch.tensor([1.0, -1, -1]))  # by way of right, up, back
    torch.testing.assert_close(named.means, usual.means @ named_from_ply.T, atol=1e-4, rtol=0)
    direction = torch.nn.functional.normalize(torch.tensor([[0.2, -0.7, 0.5]]), dim=1)
    before = sh.evaluate(usual.sh0, usual.shN, direction.expand(20, 3), 3)
    after = sh.evaluate(named.sh0, named.shN, (direction @ named_from_ply.T).expand(20, 3), 3)
    torch.testing.assert_close(after, before, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("records", "message"),
    [
        (struct.pack("<II", FRAME, 99) + b"1234", "claims 99 bytes"),
        (record(FRAME, struct.pack("<I", 17)), "0 to 16"),
        (record(FRAME, b"\1"), "0 to 16"),
    ],
)
def test_records_that_lie_are_refused(tmp_path: Path, version: int, records: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_splats(with_records(tmp_path, version, records, make_splats(2)))


def test_endless_records_are_not_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="bytes of extensions"):
        load_splats(with_records(tmp_path, 3, bytes(3 << 20), make_splats(2)))


def test_band_4_is_left_out_with_a_warning(tmp_path: Path) -> None:
    splats = make_splats(4)
    save_spz(tmp_path / "a.spz", splats)
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[12] = 4
    rows = [data[-45 * (4 - i) :][:45] + bytes([200] * 27) for i in range(4)]
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data[: -45 * 4]) + b"".join(rows), 1))
    with pytest.warns(InputWarning, match="band 4"):
        assert same_bits(load_splats(tmp_path / "b.spz"), load_splats(tmp_path / "a.spz"))
