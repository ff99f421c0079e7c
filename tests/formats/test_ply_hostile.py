"""PLY files that lie: the error says what is wrong, and memory is not taken for what the file does not hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from splat_samples import make_splats

from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats

resource = pytest.importorskip("resource")  # POSIX only


@pytest.fixture
def good(tmp_path: Path) -> bytes:
    save_splats(tmp_path / "good.ply", make_splats(3, degree=0))
    return (tmp_path / "good.ply").read_bytes()


CHANGES = {
    "too many rows": (b"vertex 3", b"vertex 1000000000000", "claims 1000000000000 rows"),
    "one row more": (b"vertex 3", b"vertex 4", "claims 4 rows"),
    "negative count": (b"vertex 3", b"vertex -3", "makes no sense"),
    "count with 5000 digits": (b"vertex 3", b"vertex " + b"9" * 5000, "makes no sense"),
    "count that is no number": (b"vertex 3", b"vertex three", "makes no sense"),
    "missing property": (b"property float rot_3\n", b"", "lacks the properties rot_3"),
    "list property": (b"property float nx", b"property list uchar float nx", "list property"),
    "lists before": (
        b"element vertex",
        b"element face 1\nproperty list uchar int i\nelement vertex",
        "before `vertex`",
    ),
    "claim before": (b"element vertex", b"element a 99999999999\nproperty double b\nelement vertex", "rows of `a`"),
    "no vertex": (b"element vertex", b"element points", "element `vertex`, got points"),
    "property without element": (b"element vertex 3\n", b"", "makes no sense"),
    "property twice": (b"float ny", b"float nx", "`nx` twice"),
    "element twice": (b"end_header", b"element vertex 3\nend_header", "`vertex` twice"),
    "unknown type": (b"float nx", b"quad nx", "makes no sense"),
    "unknown format": (b"binary_little_endian", b"binary_middle_endian", "makes no sense"),
    "no format": (b"format binary_little_endian 1.0\n", b"", "no `format`"),
    "endless header": (b"end_header", b"comment " + b"x" * 200_000 + b"\nend_header", "no `end_header`"),
    "no end": (b"end_header", b"", "no `end_header`"),
    "no magic": (b"ply\n", b"plyx\n", "must begin with"),
    "half a degree": (b"end_header", b"element z 0\nproperty float f\nend_header", None),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_header_that_lies_is_refused(tmp_path: Path, good: bytes, change: str) -> None:
    old, new, message = CHANGES[change]
    assert old in good
    path = tmp_path / "bad.ply"
    path.write_bytes(good.replace(old, new, 1))
    if message is None:  # an empty element after the splats is fine
        assert len(load_splats(path)) == 3
        return
    with pytest.raises(InputError, match=message):
        load_splats(path)


@pytest.mark.parametrize("count", [1, 8, 10, 44])
def test_an_incomplete_degree_is_refused(tmp_path: Path, good: bytes, count: int) -> None:
    rest = b"".join(b"property float f_rest_%d\n" % i for i in range(count))
    (tmp_path / "a.ply").write_bytes(good.replace(b"property float opacity", rest + b"property float opacity"))
    with pytest.raises(InputError, match=f"got {count} of them"):
        load_splats(tmp_path / "a.ply")


def test_every_truncation_is_refused(tmp_path: Path, good: bytes) -> None:
    path = tmp_path / "short.ply"
    for size in range(0, len(good), 7):
        path.write_bytes(good[:size])
        with pytest.raises(InputError):
            load_splats(path)


NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
PROPERTIES = "".join(f"property float {name}\n" for name in NAMES.split(" "))
ASCII = f"ply\nformat ascii 1.0\nelement vertex 2\n{PROPERTIES}"
ROW = " ".join(["1"] * 14) + "\n"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (ROW, "claims 2 rows"),
        (ROW + "1 2 3 4 5 6 7 8 9 10 11 12 13 \n\n\n\n\n", "row 1 must have 14 numbers, got 13"),
        (ROW + ROW.replace("1 1 ", "1 x ", 1), "row 1 holds something that is no number"),
        (ROW + ROW.replace("1 1 ", "1 nan ", 1), "`y` of row 1 must be finite"),
        (ROW + ROW.replace("1 1 ", "1 1e99 ", 1), "`y` of row 1 must be finite"),
        (ROW + " " * 100_000 + ROW, "longer than"),
        (ROW + "\n" * 40, "row 1 must have 14 numbers, got 0"),
    ],
)
def test_text_that_lies_is_refused(tmp_path: Path, body: str, message: str) -> None:
    (tmp_path / "a.ply").write_text(ASCII + "end_header\n" + body)
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "a.ply", strict=True)


def test_text_needs_no_last_line_end(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ASCII + "end_header\n" + ROW + ROW.strip())
    assert load_splats(tmp_path / "a.ply").means.tolist() == [[1, 1, 1]] * 2


def test_a_false_claim_takes_no_memory(tmp_path: Path, good: bytes) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(good.replace(b"vertex 3", b"vertex 30000000"))  # 2 GB of splats
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError):
        load_splats(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("name", ["", "absent.ply", "folder.ply"])
def test_what_is_no_file_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(InputError):
        load_splats(tmp_path / name)


def test_a_device_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "zero.splat").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="device"):
        load_splats(tmp_path / "zero.splat")
