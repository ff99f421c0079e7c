"""Limits of the readers of splats: met exactly they let a file pass, one more refuses it; and what the manual says."""

from __future__ import annotations

import gzip
import json
import math
import re
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ksplat_files import ksplat
from splat_samples import make_splats, same_bits

from gsopt.errors import InputError
from gsopt.formats import compression, glb_container, load_splats, ply_header, ply_rows, save_splats, sog, validation
from gsopt.formats import spz as spz_format
from gsopt.formats.compression import GzipStream
from gsopt.formats.placement import similarity_parts
from gsopt.formats.units import UNKNOWN, Units, units_from_comments, units_from_notes

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "howto" / "formats.md"


def test_the_manual_names_the_limits_of_what_a_file_may_decode_to() -> None:
    text = " ".join(MANUAL.read_text(encoding="utf-8").split())
    floor, ratio = re.findall(r"decodes to more than (\d+) MiB and (\d+) times its size is refused", text)[0]
    (unchecked,) = re.findall(r"unpacks to more than (\d+) times the file is read to its checksum", text)
    assert int(floor) << 20 == compression._ALWAYS_ALLOWED
    assert int(ratio) == compression._MAX_RATIO
    assert int(unchecked) == compression._UNCHECKED_RATIO
    (pixel,) = re.findall(r"Pillow takes (\d+) bytes per pixel", text)
    assert int(pixel) == sog._PIXEL_COST


def stream(folder: Path, payload: bytes) -> Path:
    (folder / "a.gz").write_bytes(gzip.compress(payload))
    return folder / "a.gz"


def test_the_rest_of_a_stream_may_be_as_long_as_its_limit(tmp_path: Path) -> None:
    path = stream(tmp_path, b"head" + b"x" * 10)
    for limit, fine in ((11, True), (10, True), (9, False)):
        with open(path, "rb") as file:
            opened = GzipStream(file, path)
            assert opened.take(4) == b"head"
            if fine:
                assert opened.rest(limit) == b"x" * 10
                opened.finish()
            else:
                with pytest.raises(InputError, match="more than 9 bytes of extensions"):
                    opened.rest(limit)


def test_a_stream_gives_what_is_asked_for_and_no_byte_beyond_its_end(tmp_path: Path) -> None:
    payload = np.random.default_rng(0).integers(0, 256, 200_000, np.uint8).tobytes()
    path = stream(tmp_path, payload)
    with open(path, "rb") as file:
        opened = GzipStream(file, path)
        opened.skip(70_000)
        assert opened.take(70_000) == payload[70_000:140_000]
        assert opened.take(60_000) == payload[140_000:]
        opened.finish()
    with open(path, "rb") as file:
        opened = GzipStream(file, path)
        opened.skip(200_000)
        with pytest.raises(InputError, match="ends 1 bytes before"):
            opened.take(1)
    with open(path, "rb") as file:
        opened = GzipStream(file, path)
        opened.skip(199_999)
        with pytest.raises(InputError, match="more than its header declares"):
            opened.finish()


def spz(
    folder: Path, *, version: int = 3, degree: int = 0, fraction: int = 12, table: int = 32, count: int = 1
) -> Path:
    """Splats of bytes 128, in version 4 with so many bytes before its table."""
    zstandard = pytest.importorskip("zstandard")
    bands = (degree + 1) ** 2 - 1
    plain = [bytes([128]) * (count * size) for size in (9, 1, 3, 3, 4, 3 * bands) if size]
    header = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, fraction, 0, len(plain) if version == 4 else 0)
    if version == 3:
        (folder / "a.spz").write_bytes(gzip.compress(header + b"".join(plain)))
    else:
        packed = [zstandard.compress(part) for part in plain]
        sizes = b"".join(struct.pack("<QQ", len(a), len(b)) for a, b in zip(packed, plain, strict=True))
        data = header + struct.pack("<I12x", table) + bytes(table - 32) + sizes + b"".join(packed)
        (folder / "a.spz").write_bytes(data)
    return folder / "a.spz"


@pytest.mark.parametrize(("degree", "fraction"), [(0, 0), (0, 23), (3, 12)])
@pytest.mark.parametrize("version", [3, 4])
def test_the_header_of_an_spz_may_hold_its_bounds(tmp_path: Path, version: int, degree: int, fraction: int) -> None:
    back = load_splats(spz(tmp_path, version=version, degree=degree, fraction=fraction))
    code = int.from_bytes(bytes([128] * 3), "little", signed=True)
    assert back.means[0].tolist() == pytest.approx([code / 2**fraction, -code / 2**fraction, -code / 2**fraction])
    assert back.sh_degree == degree


def test_the_table_of_an_spz_stands_within_a_megabyte(tmp_path: Path) -> None:
    assert len(load_splats(spz(tmp_path, version=4, table=32 + (1 << 20)))) == 1
    for table in (33 + (1 << 20),):
        with pytest.raises(InputError, match="a table at byte 32"):
            load_splats(spz(tmp_path, version=4, table=table))
    path = spz(tmp_path, version=4)
    data = bytearray(path.read_bytes())
    data[16:20] = struct.pack("<I", 31)
    path.write_bytes(data)
    with pytest.raises(InputError, match="got 5 and 31"):
        load_splats(path)


@pytest.mark.parametrize("version", [3, 4])
def test_a_file_that_is_read_twice_is_read_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    """One that unpacks to much more than its size is checked to its end before a byte is kept."""
    path = tmp_path / "a.spz"
    pytest.importorskip("zstandard")
    spz_format.save_spz(path, make_splats(50, degree=1), version=version)
    once = load_splats(path)
    monkeypatch.setattr(spz_format, "needs_check", lambda plain, packed: True)
    assert same_bits(load_splats(path), once)


def ply(folder: Path, header: bytes) -> Path:
    save_splats(folder / "whole.ply", make_splats(2, 0))
    data = (folder / "whole.ply").read_bytes()
    (folder / "a.ply").write_bytes(data.replace(b"end_header", header + b"end_header", 1))
    return folder / "a.ply"


def test_a_ply_header_may_have_64_kib(tmp_path: Path) -> None:
    empty = ply(tmp_path, b"comment \n").read_bytes()
    room = 65_536 - (empty.index(b"end_header\n") + len(b"end_header\n"))
    assert ply_header.MAX_HEADER == 65_536
    assert len(load_splats(ply(tmp_path, b"comment " + b"x" * room + b"\n"))) == 2
    with pytest.raises(InputError, match="no `end_header` in its first 65536 bytes"):
        load_splats(ply(tmp_path, b"comment " + b"x" * (room + 1) + b"\n"))


def text_ply(folder: Path, row: str, comment: str = "") -> Path:
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    lines = ["ply", "format ascii 1.0", *([comment] if comment else []), "element vertex 1"]
    lines += [*(f"property float {name}" for name in names), "end_header", ""]
    (folder / "a.ply").write_text("\n".join(lines) + row)
    return folder / "a.ply"


ROW = "1 2 3 0 0 0 0 -1 -1 -1 1 0 0 0"


def test_a_row_of_text_may_have_40_characters_for_each_number_and_40_more(tmp_path: Path) -> None:
    longest = ply_rows._MAX_TOKEN * 15
    for size, fine in ((longest - 1, True), (longest, False)):
        path = text_ply(tmp_path, ROW.ljust(size) + "\n")
        if fine:
            assert load_splats(path).means.tolist() == [[1, 2, 3]]
        else:
            with pytest.raises(InputError, match="longer than 600 characters"):
                load_splats(path)


def test_a_row_of_one_digit_for_each_number_is_long_enough(tmp_path: Path) -> None:
    row = "1 2 3 0 0 0 0 1 1 1 1 0 0 0"
    assert load_splats(text_ply(tmp_path, row)).quats.tolist() == [[1, 0, 0, 0]]
    with pytest.raises(InputError, match="claims 1 rows"):
        load_splats(text_ply(tmp_path, row[:-2]))


def glb(folder: Path, spaces: int, after: int = 0) -> Path:
    """A .glb whose JSON is filled up with spaces to a length, and so many bytes behind the splats."""
    save_splats(folder / "whole.glb", make_splats(2, 0))
    data = (folder / "whole.glb").read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    text, rest = data[20 : 20 + length].ljust(spaces), data[20 + length :] + bytes(after)
    chunk = struct.pack("<I4s", len(text), b"JSON") + text + rest
    (folder / "a.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    return folder / "a.glb"


@pytest.mark.parametrize(
    ("after", "longest"), [(0, 307_200), (1_500_000, None), (9_000_000, 1_048_576)], ids=["small", "share", "large"]
)
def test_the_json_of_a_glb_is_bounded_by_its_file(tmp_path: Path, after: int, longest: int | None) -> None:
    """300 KiB are always allowed, beyond them three tenths of the file, a mebibyte at most."""
    if longest is None:
        others = glb(tmp_path, 400_000, after).stat().st_size - 400_000
        longest = int(others * 0.3 / 0.7)
        while longest + 1 <= int(0.3 * (others + longest + 1)):
            longest += 1
    assert len(load_splats(glb(tmp_path, longest, after))) == 2
    with pytest.raises(InputError, match="the JSON may have"):
        load_splats(glb(tmp_path, longest + 1, after))


def test_the_scene_of_a_glb_shows_its_only_mesh(tmp_path: Path) -> None:
    """Readers that know glTF find the splats from the scene down."""
    data = glb(tmp_path, 0).read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    (node,) = document["scenes"][document["scene"]]["nodes"]
    (primitive,) = document["meshes"][document["nodes"][node]["mesh"]]["primitives"]
    assert {document["bufferViews"][row["bufferView"]]["buffer"] for row in document["accessors"]} == {0}
    assert sorted(primitive["attributes"].values()) == list(range(len(document["accessors"])))
    assert {view["target"] for view in document["bufferViews"]} == {34962}  # vertex attributes


def test_numbers_of_a_glb_document_are_checked(tmp_path: Path) -> None:
    document = glb_container.Document({"a": [{}], "n": ["x"]}, 0, 0, tmp_path / "a.glb")
    assert document.integer({"k": 0}, "k") == 0
    assert document.integer({}, "k", 3) == 3
    assert document.item("a", 0) == {}
    assert document.names("n") == ["x"]
    assert document.object({}, "k") == {}
    for wrong in (-1, True, 1.0, None, "1"):
        with pytest.raises(InputError, match="must be an integer"):
            document.integer({"k": wrong}, "k")
    with pytest.raises(InputError, match="must have an item 1, got 1 items"):
        document.item("a", 1)
    with pytest.raises(InputError, match="a list of names"):
        document.names("a")


def sog_with(folder: Path, change: Any, count: int = 70) -> Path:
    """A .sog with another meta.json."""
    save_splats(folder / "whole.sog", make_splats(count, degree=1))
    with zipfile.ZipFile(folder / "whole.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    text = change(meta)
    files["meta.json"] = (json.dumps(meta) if text is None else text(json.dumps(meta))).encode()
    with zipfile.ZipFile(folder / "a.sog", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return folder / "a.sog"


def test_the_meta_of_a_sog_may_have_128_kib(tmp_path: Path) -> None:
    assert len(load_splats(sog_with(tmp_path, lambda meta: lambda text: text.ljust(131_072)))) == 70
    with pytest.raises(InputError, match=r"meta\.json. has more than 131072 bytes"):
        load_splats(sog_with(tmp_path, lambda meta: lambda text: text.ljust(131_073)))


def test_positions_of_a_sog_may_reach_the_end_of_their_range(tmp_path: Path) -> None:
    def reach(meta: dict[str, Any]) -> None:
        meta["means"].update(mins=[-88, -88, -88], maxs=[88, 88, 88])

    assert float(load_splats(sog_with(tmp_path, reach)).means.abs().max()) > 1e35


@pytest.mark.parametrize(("value", "fine"), [(0.9e30, True), (1e30, False), (-1e30, False), (True, False)])
def test_numbers_of_a_sog_are_below_1e30(tmp_path: Path, value: object, fine: bool) -> None:
    def change(meta: dict[str, Any]) -> None:
        meta["sh0"]["codebook"][255] = value

    if fine:
        assert len(load_splats(sog_with(tmp_path, change))) == 70
    else:
        with pytest.raises(InputError, match="256 finite"):
            load_splats(sog_with(tmp_path, change))


def test_the_section_of_a_ksplat_may_hold_what_it_claims_and_no_more(tmp_path: Path) -> None:
    data = bytearray(ksplat(1, 5, 1))
    path = tmp_path / "a.ksplat"
    for half_range, offset in ((0, 4), (32767, 4), (16383, 4)):  # 0 stands for 32767
        struct.pack_into("<I", data, 4096 + 24, half_range)
        path.write_bytes(data)
        steps = (32767 if half_range in (0, 32767) else 16383) / 32767
        found, expected = load_splats(path).means[0], 0.5
        assert float(found[0]) == pytest.approx(expected + (1 / steps - 1) * offset / 2, abs=1e-3)
    path.write_bytes(bytes(ksplat(1, 5, 1))[:-1])
    with pytest.raises(InputError, match="ends 1 bytes before"):
        load_splats(path)
    wide = bytearray(ksplat(2, 5, 1))
    struct.pack_into("<ff", wide, 36, -3.0, 3.0)
    path.write_bytes(wide)
    twice = load_splats(path).shN
    struct.pack_into("<ff", wide, 36, 0.0, 0.0)  # not given: -1.5 to 1.5
    path.write_bytes(wide)
    torch.testing.assert_close(twice, 2 * load_splats(path).shN)


@pytest.mark.parametrize(("scale", "fine"), [(1.1e-12, True), (0.9e-12, False), (0.9e12, True), (1.1e12, False)])
def test_a_similarity_has_a_scale_that_float32_follows(scale: float, fine: bool) -> None:
    assert (similarity_parts(scale * torch.eye(3, dtype=torch.float64)) is not None) == fine


@pytest.mark.parametrize(("shear", "fine"), [(0.9e-4, True), (1.1e-4, False)])
def test_a_similarity_may_be_sheared_by_a_ten_thousandth(shear: float, fine: bool) -> None:
    linear = 5 * torch.eye(3, dtype=torch.float64)
    linear[0, 1] = 5 * shear
    assert (similarity_parts(linear) is not None) == fine


@pytest.mark.parametrize(
    ("notes", "units"),
    [
        ({"meters_per_unit": 0.25, "origin": [1, 2.5, -3]}, Units(0.25, (1.0, 2.5, -3.0))),
        ({"meters_per_unit": 0}, UNKNOWN),
        ({"meters_per_unit": -1.0}, UNKNOWN),
        ({"meters_per_unit": True}, UNKNOWN),
        ({"meters_per_unit": 9e299}, Units(9e299)),
        ({"meters_per_unit": 1e300}, UNKNOWN),
        ({"meters_per_unit": math.inf}, UNKNOWN),
        ({"meters_per_unit": 2, "origin": [1, 2]}, Units(2.0)),
        ({"origin": [1, 2, 3, 4]}, UNKNOWN),
        ({"origin": [1, None, 3]}, UNKNOWN),
        ({"origin": (1, 2, 3)}, UNKNOWN),
        ([], UNKNOWN),
    ],
)
def test_notes_about_units_are_numbers_or_nothing(notes: Any, units: Units) -> None:
    assert units_from_notes(notes) == units
    if notes and units != UNKNOWN:
        assert units_from_notes(units.notes()) == units_from_comments(units.comments()) == units


def test_comments_about_units_are_read_in_any_case() -> None:
    assert units_from_comments([" METERS per unit: 0.5", "Origin:  1 2 3 "]) == Units(0.5, (1.0, 2.0, 3.0))
    assert units_from_comments(["origin: 1 x 3", "meters per unit: x", "nothing"]) == UNKNOWN


def test_a_rotation_is_usable_from_the_least_length_that_can_be_normalized() -> None:
    tiny = math.sqrt(torch.finfo(torch.float32).tiny)
    quats = torch.tensor([[1.01 * tiny, 0, 0, 0], [0.99 * tiny, 0, 0, 0], [1e18, 0, 0, 0], [1e20, 0, 0, 0]])
    assert validation._has_length(quats).tolist() == [True, False, True, False]


def test_opacities_are_stored_as_the_bytes_1_to_254() -> None:
    values = torch.tensor([0.0, 0.4 / 255, 1.6 / 255, 0.5, 253.4 / 255, 1.0])
    assert validation.opacity_bytes(values).tolist() == [1, 1, 2, 128, 253, 254]
    assert validation.to_bytes(torch.tensor([-3.0, 0.6, 254.4, 300.0])).tolist() == [0, 1, 254, 255]


def test_names_of_columns_are_those_of_a_ply() -> None:
    names = [validation.ply_name("shN", [k, c], 15) for k, c in ((0, 0), (1, 2), (14, 2))]
    assert names == ["f_rest_0", "f_rest_31", "f_rest_44"]
    others = [("means", [1]), ("sh0", [0, 2]), ("logit_opacities", []), ("quats", [3]), ("log_scales", [2])]
    found = [validation.ply_name(name, index, 15) for name, index in others]
    assert found == ["y", "f_dc_2", "opacity", "rot_3", "scale_2"]


@pytest.mark.parametrize("version", [2, 5])
def test_a_spz_is_written_in_versions_3_and_4_alone(tmp_path: Path, version: int) -> None:
    with pytest.raises(InputError, match=f"must be 3 or 4, got {version}"):
        spz_format.save_spz(tmp_path / "a.spz", make_splats(2), version=version)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh0", "shN"])
def test_rows_of_another_shape_are_refused_by_name(name: str) -> None:
    splats = make_splats(4)
    validation._check_shapes(splats, Path("a.ply"))
    broken = replace(splats, **{name: getattr(splats, name)[..., None]})
    with pytest.raises(InputError, match=f"a.ply: `{name}` must have shape"):
        validation._check_shapes(broken, Path("a.ply"))
