"""Splat files: what is written is read, gsopt reads the same, and a file that lies is refused by name."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from made_splats import random_splats

from blender_addon.core.errors import InputError
from blender_addon.core.ply import read_ply, write_ply
from blender_addon.core.splats import Splats
from blender_addon.core.spz import read_spz


def assert_alike(a: Splats, b: Splats, tolerance: float) -> None:
    for field in fields(Splats):
        left, right = np.asarray(getattr(a, field.name)), np.asarray(getattr(b, field.name))
        assert left.shape == right.shape
        assert np.allclose(left, right, rtol=tolerance, atol=tolerance), field.name


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_what_is_written_is_read(odd_folder: Path, bands: int, count: int) -> None:
    splats = random_splats(count, bands)
    write_ply(odd_folder / "a.ply", splats, comment="SplatRenderMode: default")
    assert_alike(read_ply(odd_folder / "a.ply"), splats, 1e-5)


def test_a_second_round_changes_no_position_color_or_byte_of_sh(odd_folder: Path, some_splats: Splats) -> None:
    write_ply(odd_folder / "a.ply", some_splats)
    again = read_ply(odd_folder / "a.ply")
    for name in ("positions", "base", "sh"):
        assert np.array_equal(getattr(again, name), getattr(some_splats, name))


def test_opacities_of_0_and_1_stay_finite(odd_folder: Path, some_splats: Splats) -> None:
    some_splats.opacities[:2] = 0, 1
    some_splats.scales[0] = 0
    write_ply(odd_folder / "a.ply", some_splats)
    again = read_ply(odd_folder / "a.ply")
    assert again.opacities[0] < 1e-6
    assert again.opacities[1] > 1 - 1e-6
    assert again.scales[0].max() < 1e-37


@pytest.mark.parametrize(
    "columns",
    [
        lambda names: [("red", ">u1"), *((name, ">f8") for name in reversed(names))],
        lambda names: [(name, ">f4" if name in "xyz" else ">f8") for name in names],
    ],
    ids=["reversed doubles after a byte", "floats before doubles"],
)
def test_columns_in_any_order_and_type_are_found(
    tmp_path: Path, some_splats: Splats, columns: Callable[[list[str]], list[tuple[str, str]]]
) -> None:
    write_ply(tmp_path / "a.ply", some_splats)
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.splitlines() if line.startswith(b"property")]
    rows = np.frombuffer(data, np.dtype([(name, "<f4") for name in names]))
    other = np.empty(len(rows), np.dtype(columns(names)))
    for name in names:
        other[name] = rows[name]
    kinds = {">u1": "uchar", ">f4": "float", ">f8": "double"}
    lines = ["ply", "format binary_big_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {kinds[kind]} {name}" for name, kind in columns(names)]
    (tmp_path / "b.ply").write_bytes("\n".join([*lines, "end_header", ""]).encode() + other.tobytes())
    assert_alike(read_ply(tmp_path / "b.ply"), read_ply(tmp_path / "a.ply"), 0)


def ply_with(tmp_path: Path, old: bytes, new: bytes, cut: int = 0) -> Path:
    write_ply(tmp_path / "good.ply", random_splats(20, 0))
    data = (tmp_path / "good.ply").read_bytes()
    assert old in data
    lying = data.replace(old, new, 1)
    (tmp_path / "bad.ply").write_bytes(lying[: len(lying) - cut])
    return tmp_path / "bad.ply"


@pytest.mark.parametrize(
    ("old", "new", "cut", "said"),
    [
        (b"vertex 20", b"vertex 900000000", 0, "claims 900,000,000 rows"),
        (b"vertex 20", b"vertex -3", 0, "makes no sense"),
        (b"", b"", 100, "cut short"),
        (b"binary_little_endian", b"ascii", 0, "not a binary PLY"),
        (b"ply\n", b"obj\n", 0, "no PLY file"),
        (b"end_header", b"end_of_it_", 0, "no PLY file"),
        (b"float opacity", b"float clarity", 0, "lacks opacity"),
        (b"float nx", b"float f_rest_0", 0, "f_rest_*"),
        (b"float nx", b"list uchar int nx", 0, "makes no sense"),
        (b"float nx", b"float x", 0, "makes no sense"),
        (b"element vertex", b"element face", 0, "no element `vertex`"),
    ],
)
def test_a_ply_that_lies_is_refused(tmp_path: Path, old: bytes, new: bytes, cut: int, said: str) -> None:
    with pytest.raises(InputError, match=r"bad\.ply") as caught:
        read_ply(ply_with(tmp_path, old, new, cut))
    assert said in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("positions", np.nan), ("scales", np.inf), ("rotations", 0.0)])
def test_a_splat_that_cannot_be_drawn_is_left_out_and_counted(
    tmp_path: Path, some_splats: Splats, name: str, value: float
) -> None:
    getattr(some_splats, name)[7] = value
    with np.errstate(invalid="ignore"):
        write_ply(tmp_path / "a.ply", some_splats)
    with np.errstate(invalid="ignore"):
        again = read_ply(tmp_path / "a.ply")
    assert again.left_out == 1
    assert len(again) == len(some_splats) - 1
    assert np.array_equal(again.base, np.delete(some_splats.base, 7, axis=0))


def test_an_infinite_logit_is_an_opacity_of_0_or_1_and_nan_alone_is_refused(
    tmp_path: Path, some_splats: Splats
) -> None:
    write_ply(tmp_path / "a.ply", some_splats)
    head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    rows = np.frombuffer(data, "<f4").reshape(len(some_splats), -1).copy()
    rows[:2, -8] = -np.inf, np.inf
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + rows.tobytes())
    assert read_ply(tmp_path / "b.ply").opacities[:2].tolist() == [0, 1]
    rows[:] = np.nan
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + rows.tobytes())
    with pytest.raises(InputError, match="no splat that can be drawn"):
        read_ply(tmp_path / "b.ply")


def test_a_failed_write_keeps_the_old_file(
    tmp_path: Path, some_splats: Splats, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "a.ply"
    target.write_bytes(b"old")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_ply(target, some_splats)
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_gsopt_reads_what_the_extension_writes_and_the_other_way_round(tmp_path: Path, some_splats: Splats) -> None:
    torch = pytest.importorskip("torch")
    import gsopt
    from gsopt.formats.ply import save_ply

    write_ply(tmp_path / "a.ply", some_splats)
    theirs = gsopt.load_splats(tmp_path / "a.ply")
    assert np.allclose(theirs.opacities.numpy(), some_splats.opacities, atol=1e-6)
    assert np.allclose(theirs.log_scales.exp().numpy(), some_splats.scales, rtol=1e-5)
    assert torch.equal(theirs.shN, torch.from_numpy(some_splats.sh))
    save_ply(tmp_path / "b.ply", theirs)
    assert_alike(read_ply(tmp_path / "b.ply"), some_splats, 1e-5)


@pytest.mark.parametrize("bands", [0, 15])
def test_spz_means_the_same_as_to_gsopt(tmp_path: Path, bands: int) -> None:
    pytest.importorskip("torch")
    import gsopt
    from gsopt.formats.ply import save_ply
    from gsopt.formats.spz import save_spz

    write_ply(tmp_path / "a.ply", random_splats(300, bands))
    save_spz(tmp_path / "a.spz", gsopt.load_splats(tmp_path / "a.ply"))
    save_ply(tmp_path / "b.ply", gsopt.load_splats(tmp_path / "a.spz"))
    ours, theirs = read_spz(tmp_path / "a.spz"), read_ply(tmp_path / "b.ply")
    same_side = np.sign((ours.rotations * theirs.rotations).sum(axis=1, keepdims=True))
    ours.rotations[:] *= same_side
    assert_alike(ours, theirs, 1e-5)


@pytest.mark.parametrize("version", [2, 3])
def test_any_codes_of_an_spz_mean_the_same_as_to_gsopt(tmp_path: Path, version: int) -> None:
    pytest.importorskip("torch")
    import gsopt
    from gsopt.formats.ply import save_ply

    count, bands = 500, 8
    row = 9 + 1 + 3 + 3 + (3 if version == 2 else 4) + 3 * bands
    codes = np.random.default_rng(version).integers(0, 256, count * row, np.uint8)
    header = struct.pack("<4sIIBBBB", b"NGSP", version, count, 2, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + codes.tobytes()))
    save_ply(tmp_path / "b.ply", gsopt.load_splats(tmp_path / "a.spz"))
    ours, theirs = read_spz(tmp_path / "a.spz"), read_ply(tmp_path / "b.ply")
    assert len(ours) > count // 2
    ours.rotations[:] *= np.sign((ours.rotations * theirs.rotations).sum(axis=1, keepdims=True))
    assert_alike(ours, theirs, 1e-5)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "ends before"),
        (b"NGSP" + bytes(20), "version 4"),
        (b"no gzip at all", "damaged"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000_000, 3, 12, 0, 0)), "claims"),
        # 80 MB out of 20 kB: within what may always be claimed are only 64 MB, and 50 times the size of the file.
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000, 0, 12, 0, 0)) + bytes(20_000), "claims"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 3, 12, 0, 0) + bytes(50)), "ends before"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 9, 12, 0, 0)), "SH degree 9"),
        (gzip.compress(struct.pack("<4sIIBBBB", b"GNSP", 3, 10, 0, 12, 0, 0)), "no .spz"),
        (gzip.compress(bytes(1 << 20))[:200], "no .spz"),
    ],
)
def test_an_spz_that_lies_is_refused(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / "bad.spz").write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_spz(tmp_path / "bad.spz")
    assert said in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for read in (read_ply, read_spz):
        with pytest.raises(InputError, match=r"gone"):
            read(tmp_path / "gone")


def test_a_header_of_many_long_names_is_refused_in_a_short_message(tmp_path: Path) -> None:
    elements = b"".join(b"element %s 0\n" % (letter * 900) for letter in (b"a", b"b", b"c"))
    (tmp_path / "a.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n" + elements + b"end_header\n")
    with pytest.raises(InputError, match="no element `vertex`") as refused:
        read_ply(tmp_path / "a.ply")
    assert len(str(refused.value)) < len(str(tmp_path)) + 100
