"""The .spz container and its codes, checked against bytes put together by hand."""

from __future__ import annotations

import gzip
import math
import struct
import sys
from pathlib import Path

import pytest
import torch
from splat_samples import errors, make_splats, same_bits

from gsopt.errors import InputError, MissingDependency
from gsopt.formats import load_splats, save_splats
from gsopt.formats.spz import save_spz
from gsopt.formats.spz_codes import stream_sizes

HEADER = struct.Struct("<4sIIBBBB")


def one_splat(version: int, rotation: bytes, degree: int = 0, rest: bytes = b"") -> bytes:
    """Position (1, -2, 0.5) with 12 fraction bits in the file's frame, alpha 51, colors 255 127 0, scales 0 160 255."""
    positions = b"".join(int(v * 4096).to_bytes(3, "little", signed=True) for v in (1, -2, 0.5))
    header = HEADER.pack(b"NGSP", version, 1, degree, 12, 0, 0)
    return header + positions + bytes([51, 255, 127, 0, 0, 160, 255]) + rotation + rest


def load_bytes(path: Path, payload: bytes):
    path.write_bytes(gzip.compress(payload))
    return load_splats(path)


def smallest_three(largest: int, fields: list[tuple[int, int]]) -> bytes:
    """(sign, magnitude) of the three others in the order x y z w."""
    code = largest
    for sign, magnitude in fields:
        code = code << 10 | sign << 9 | magnitude
    return struct.pack("<I", code)


def test_known_bytes_read_as_known_values(tmp_path: Path) -> None:
    splats = load_bytes(tmp_path / "a.spz", one_splat(3, smallest_three(3, [(0, 511), (1, 0), (1, 0)])))
    assert splats.means.tolist() == [[1, 2, -0.5]]  # right, up, back -> right, down, forward
    assert splats.log_scales.tolist() == [[-10, 0, 255 / 16 - 10]]
    assert splats.opacities.item() == pytest.approx(0.2)
    assert splats.sh0[0, 0].tolist() == pytest.approx([0.5 / 0.15, (127 / 255 - 0.5) / 0.15, -0.5 / 0.15])
    assert splats.quats[0].tolist() == pytest.approx([math.sqrt(0.5), math.sqrt(0.5), 0, 0])
    assert splats.sh_degree == 0


@pytest.mark.parametrize("degree", range(4))
def test_the_header_of_version_3_is_known_to_the_bit(tmp_path: Path, degree: int) -> None:
    """Its last byte is reserved: other readers may refuse what they do not know."""
    for antialiased in (False, True):
        save_spz(tmp_path / "a.spz", make_splats(7, degree), antialiased=antialiased)
        header = gzip.decompress((tmp_path / "a.spz").read_bytes())[: HEADER.size]
        assert header == HEADER.pack(b"NGSP", 3, 7, degree, 16, int(antialiased), 0)


@pytest.mark.parametrize(
    ("largest", "expected"),
    [(0, [0.3, 1, -0.1, -0.2]), (1, [0.3, 0.1, -1, -0.2]), (2, [0.3, 0.1, -0.2, -1]), (3, [1, 0.1, -0.2, -0.3])],
)
def test_the_largest_component_stands_where_the_code_says(tmp_path: Path, largest: int, expected: list[float]) -> None:
    fields = [(0, round(part * 511 / math.sqrt(0.5))) for part in (0.1, 0.2, 0.3)]
    quat = load_bytes(tmp_path / "a.spz", one_splat(3, smallest_three(largest, fields))).quats[0]
    unit = math.sqrt(1 - 0.01 - 0.04 - 0.09)
    want = [math.copysign(unit, part) if abs(part) == 1 else part for part in expected]
    assert quat.tolist() == pytest.approx(want, abs=1e-3)


def test_version_2_stores_three_bytes_of_rotation(tmp_path: Path) -> None:
    splats = load_bytes(tmp_path / "a.spz", one_splat(2, bytes([204, 127, 128])))
    x = 204 / 127.5 - 1
    assert splats.quats[0].tolist() == pytest.approx([math.sqrt(1 - x * x), x, 0, 0], abs=0.005)
    assert splats.means.tolist() == [[1, 2, -0.5]]


def test_bands_are_color_fastest_and_turn_with_the_frame(tmp_path: Path) -> None:
    codes = bytes(range(128, 137))
    splats = load_bytes(tmp_path / "a.spz", one_splat(3, smallest_three(3, [(0, 0)] * 3), 1, codes))
    rows = torch.arange(9.0).reshape(3, 3) / 128
    torch.testing.assert_close(splats.shN[0], rows * torch.tensor([[-1.0], [-1.0], [1.0]]))  # odd in y, z, x


def test_version_4_reads_back_as_version_3(tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    save_spz(tmp_path / "3.spz", make_splats(), version=3)
    save_spz(tmp_path / "4.spz", make_splats(), version=4)
    assert (tmp_path / "4.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    assert same_bits(load_splats(tmp_path / "4.spz"), load_splats(tmp_path / "3.spz"))
    save_spz(tmp_path / "0.spz", make_splats(degree=0), version=4)
    assert errors(make_splats(degree=0), load_splats(tmp_path / "0.spz")).means < 1e-4


def test_without_zstandard_the_error_has_the_pip_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zstandard")
    save_spz(tmp_path / "a.spz", make_splats(), version=4)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(MissingDependency, match=r"pip install 'gsopt\[spz\]'"):
        load_splats(tmp_path / "a.spz")
    save_splats(tmp_path / "b.spz", make_splats())  # version 3 needs nothing


@pytest.mark.parametrize(
    ("header", "message"),
    [
        (HEADER.pack(b"NGSX", 3, 1, 0, 12, 0, 0), "NGSP"),
        (HEADER.pack(b"NGSP", 1, 1, 0, 12, 0, 0), "version"),
        (HEADER.pack(b"NGSP", 4, 1, 0, 12, 0, 0), "version"),
        (HEADER.pack(b"NGSP", 3, 1, 5, 12, 0, 0), "SH degree"),
        (HEADER.pack(b"NGSP", 3, 1, 0, 24, 0, 0), "fraction bits"),
        (HEADER.pack(b"NGSP", 3, 1, 0, 12, 4, 0), "flags"),
        (HEADER.pack(b"NGSP", 3, 2, 0, 12, 0, 0), "before its last splat"),
        (HEADER.pack(b"NGSP", 3, 0, 0, 12, 0, 0), "more than its header declares"),
        (HEADER.pack(b"NGSP", 3, 200_000_000, 3, 12, 0, 0), "times its size"),
        (HEADER.pack(b"NGSP", 3, 2**32 - 1, 3, 12, 0, 0), "claims"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, header: bytes, message: str) -> None:
    body = one_splat(3, smallest_three(3, [(0, 0)] * 3))[HEADER.size :]
    with pytest.raises(InputError, match=message):
        load_bytes(tmp_path / "a.spz", header + body)


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    """A header may claim what 70 kB of zeros unpack to; the claim alone is refused."""
    resource = pytest.importorskip("resource")
    count = 1_100_000
    payload = HEADER.pack(b"NGSP", 3, count, 3, 12, 0, 0)
    packer = gzip.compress(payload + bytes(65 * count), compresslevel=1)
    (tmp_path / "a.spz").write_bytes(packer)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="times its size"):
        load_splats(tmp_path / "a.spz")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("version", [2, 3, 4])
def test_a_small_file_decodes_to_little(tmp_path: Path, version: int, degree: int) -> None:
    """Equal splats pack to a thousandth: the parameters of a small file are bounded by 8 MiB, not by its claim."""
    zstandard = pytest.importorskip("zstandard")
    for count, allowed in ((8000, True), (400_000, False)):
        sizes = [size for size in stream_sizes(count, degree, version) if size]
        header = HEADER.pack(b"NGSP", version, count, degree, 12, 0, len(sizes) if version == 4 else 0)
        data = gzip.compress(header + bytes(sum(sizes)), 9)
        if version == 4:
            streams = [zstandard.compress(bytes(size)) for size in sizes]
            table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
            data = header + struct.pack("<I12x", 32) + table + b"".join(streams)
        (tmp_path / "a.spz").write_bytes(data)
        if allowed:
            assert len(load_splats(tmp_path / "a.spz")) == count
        else:
            with pytest.raises(InputError, match="claims to decode from"):
                load_splats(tmp_path / "a.spz")


def test_a_zstandard_bomb_is_not_unpacked(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    count = 20
    sizes = (9 * count, count, 3 * count, 3 * count, 4 * count)
    streams = [zstandard.compress(bytes(50_000_000))] + [zstandard.compress(bytes(size)) for size in sizes[1:]]
    table = b"".join(struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True))
    head = HEADER.pack(b"NGSP", 4, count, 0, 12, 0, 5) + struct.pack("<I12x", 32)
    (tmp_path / "a.spz").write_bytes(head + table + b"".join(streams))
    with pytest.raises(InputError, match=f"must unpack to {9 * count}"):
        load_splats(tmp_path / "a.spz")


@pytest.mark.parametrize("version", [3, 4])
def test_every_truncation_is_refused(tmp_path: Path, version: int) -> None:
    pytest.importorskip("zstandard")
    save_spz(tmp_path / "a.spz", make_splats(3, degree=1), version=version)
    data = (tmp_path / "a.spz").read_bytes()
    for size in range(0, len(data), 3):
        (tmp_path / "b.spz").write_bytes(data[:size])
        with pytest.raises(InputError):
            load_splats(tmp_path / "b.spz")


def test_gzip_that_changed_fails_its_checksum(tmp_path: Path) -> None:
    data = bytearray(gzip.compress(one_splat(3, smallest_three(3, [(0, 0)] * 3)), compresslevel=0))
    data[-20] ^= 1
    (tmp_path / "a.spz").write_bytes(bytes(data))
    with pytest.raises(InputError, match="damaged"):
        load_splats(tmp_path / "a.spz")
