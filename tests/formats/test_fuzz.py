"""Whatever bytes a file holds, reading it gives finite Gaussians or an InputError, and nothing else."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ksplat_files import ksplat
from splat_laws import reads_or_refuses
from splat_samples import make_splats

from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats
from gsopt.formats.spz import save_spz

NAMES = ["a.ply", "a.compressed.ply", "a.splat", "3.spz", "4.spz", "a.sog", "a.glb", "a.ksplat"]
STARTS = {"a.ply": b"ply\nformat binary_little_endian 1.0\n", "3.spz": b"\x1f\x8b\x08", "4.spz": b"NGSP\4\0\0\0"}
STARTS |= {"a.glb": b"glTF\2\0\0\0", "a.compressed.ply": b"ply\nformat ascii 1.0\nelement chunk 1\n", "a.splat": b""}
STARTS |= {"a.sog": b"PK\3\4", "a.ksplat": b"\0\1\0\0\1\0\0\0"}
FUZZ = settings(max_examples=120, deadline=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def good(folder: Path) -> dict[str, bytes]:
    pytest.importorskip("zstandard")
    for name in NAMES:
        if name == "4.spz":
            save_spz(folder / name, make_splats(3, degree=1), version=4)
        elif name == "a.ksplat":
            (folder / name).write_bytes(ksplat(1, 3, 1))
        else:
            save_splats(folder / name, make_splats(3, degree=1))
    return {name: (folder / name).read_bytes() for name in NAMES}


def load(folder: Path, name: str, data: bytes) -> None:
    path = folder / f"fuzzed.{name}"
    path.write_bytes(data)
    reads_or_refuses(path)


@pytest.mark.parametrize("name", NAMES)
@FUZZ
@given(tail=st.binary(max_size=400), with_start=st.booleans())
def test_random_bytes(folder: Path, name: str, tail: bytes, with_start: bool) -> None:
    load(folder, name, (STARTS[name] if with_start else b"") + tail)


@pytest.mark.parametrize("name", NAMES)
@FUZZ
@given(data=st.data())
def test_cut_flipped_and_spliced(folder: Path, good: dict[str, bytes], name: str, data: st.DataObject) -> None:
    changed = bytearray(good[name])
    for _ in range(data.draw(st.integers(1, 4))):
        end = (
            44 if name == "a.ksplat" and data.draw(st.booleans()) else len(changed)
        )  # most of a .ksplat's header is empty
        at = data.draw(st.integers(0, max(0, min(end, len(changed)) - 1)))
        match data.draw(st.sampled_from(["flip", "set", "cut", "insert", "remove"])):
            case "flip" if changed:
                changed[at] ^= 1 << data.draw(st.integers(0, 7))
            case "set" if changed:
                changed[at] = data.draw(st.sampled_from([0, 127, 128, 255, 45, 57]))
            case "cut":
                del changed[at:]
            case "insert":
                changed[at:at] = data.draw(st.binary(max_size=8))
            case _:
                del changed[at : at + data.draw(st.integers(1, 8))]
    load(folder, name, bytes(changed))


@FUZZ
@given(data=st.data())
def test_spz_changed_inside_its_compression(folder: Path, good: dict[str, bytes], data: st.DataObject) -> None:
    """Behind the checksum: the header and the codes themselves."""
    payload = bytearray(gzip.decompress(good["3.spz"]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, 40))
        payload[at] = data.draw(st.integers(0, 255))
    load(folder, "3.spz", gzip.compress(bytes(payload), 1))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=4,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in inside for place in places(item, (*path, key)))]


@settings(max_examples=400, deadline=None)
@given(data=st.data())
def test_glb_with_any_value_at_any_place(folder: Path, good: dict[str, bytes], data: st.DataObject) -> None:
    whole = good["a.glb"]
    length = struct.unpack_from("<I", whole, 12)[0]
    document = json.loads(whole[20 : 20 + length])
    *path, key = data.draw(st.sampled_from(places(document)[1:]))
    target = document
    for step in path:
        target = target[step]
    target[key] = data.draw(JSON | st.integers(0, 40))
    text = json.dumps(document).encode()
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + whole[20 + length :]
    load(folder, "a.glb", struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@FUZZ
@given(data=st.data())
def test_ply_with_any_words_in_its_header(folder: Path, good: dict[str, bytes], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["a.ply", "a.compressed.ply"]))
    head, body = good[name].split(b"end_header\n", 1)
    words = head.split(b" ")
    words[data.draw(st.integers(0, len(words) - 1))] = data.draw(
        st.sampled_from([b"float", b"list", b"x\nproperty double", b"vertex", b"-1", b"999999999999", b"0\n", b"2"])
    )
    load(folder, name, b" ".join(words) + b"end_header\n" + body)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_a_signaling_nan_is_refused_without_a_warning(
    folder: Path, good: dict[str, bytes], kind: str, order: str
) -> None:
    head, body = good["a.ply"].split(b"end_header\n", 1)
    rows = np.frombuffer(body, "<f4").astype(np.float64 if kind == "double" else np.float32)
    bits = np.uint64(0x7FF0000000000001) if kind == "double" else np.uint32(0x7F800001)
    rows.view(bits.dtype)[0] = bits
    data = rows.astype(rows.dtype.newbyteorder("<" if order == "little" else ">"))
    head = head.replace(b"property float", f"property {kind}".encode()).replace(b"little", order.encode())
    (folder / "nan.ply").write_bytes(head + b"end_header\n" + data.tobytes())
    with pytest.raises(InputError, match="must be finite"):
        load_splats(folder / "nan.ply", strict=True)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["a.splat", "a.glb", "a.compressed.ply"])
@pytest.mark.parametrize("nan", [b"\x01\0\x80\x7f", b"\x01\0\x80\xff"])
def test_a_signaling_nan_anywhere_prints_no_warning(
    folder: Path, good: dict[str, bytes], name: str, nan: bytes
) -> None:
    for at in range(len(good[name]) % 4, len(good[name]) - 3, 4):
        load(folder, name, good[name][:at] + nan + good[name][at + 4 :])
