"""Splats in binary glTF: what the writer promises to other readers, and what the reader takes from other writers."""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splat_samples import errors, make_splats

from gsopt.errors import InputError
from gsopt.formats import gltf, load_splats, save_splats
from gsopt.formats.linear_color import linear_from_srgb, srgb_from_linear
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.quats import rotation_matrices

EXTENSION = "KHR_gaussian_splatting"
FLOAT, BYTE, SHORT, UBYTE, USHORT = 5126, 5120, 5122, 5121, 5123


def parse(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def write(path: Path, document: dict[str, Any], binary: bytes) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def primitive(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]


def attribute(document: dict[str, Any], binary: bytes, name: str) -> np.ndarray:
    """A tightly packed float attribute, read by the words of the glTF specification."""
    accessor = document["accessors"][primitive(document)["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    return np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def test_the_file_is_what_gltf_asks_for(tmp_path: Path) -> None:
    splats = make_splats(5)
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")
    assert document["extensionsUsed"] == [EXTENSION]
    assert primitive(document)["mode"] == 0
    assert primitive(document)["extensions"][EXTENSION] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    assert document["buffers"] == [{"byteLength": len(binary)}]
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    assert (tmp_path / "a.glb").stat().st_size % 4 == 0
    positions = attribute(document, binary, "POSITION")
    accessor = document["accessors"][primitive(document)["attributes"]["POSITION"]]
    assert accessor["min"] == positions.min(axis=0).tolist()
    assert accessor["max"] == positions.max(axis=0).tolist()


def test_the_values_are_activated_and_left_up_forward(tmp_path: Path) -> None:
    splats = make_splats(5)
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")

    def read(name: str) -> torch.Tensor:
        return torch.from_numpy(attribute(document, binary, name).copy())

    torch.testing.assert_close(read("POSITION"), splats.means * torch.tensor([-1, -1, 1]))
    torch.testing.assert_close(read(f"{EXTENSION}:SCALE"), splats.scales)
    torch.testing.assert_close(read(f"{EXTENSION}:OPACITY")[:, 0], splats.opacities)
    torch.testing.assert_close(read(f"{EXTENSION}:ROTATION").norm(dim=1), torch.ones(5))
    torch.testing.assert_close(read(f"{EXTENSION}:SH_DEGREE_0_COEF_0"), splats.sh0[:, 0])
    torch.testing.assert_close(read(f"{EXTENSION}:SH_DEGREE_1_COEF_0"), -splats.shN[:, 0])  # odd in y
    torch.testing.assert_close(read(f"{EXTENSION}:SH_DEGREE_3_COEF_3"), splats.shN[:, 11])  # odd in z


def test_interleaved_and_quantized_accessors_read_the_same(tmp_path: Path) -> None:
    splats = make_splats(6, degree=0)
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")
    rows = np.zeros(
        6,
        [
            ("POSITION", "<f4", 3),
            ("ROTATION", "<i2", 4),
            ("SCALE", "<f4", 3),
            ("OPACITY", "<u2"),
            ("pad", "<u2"),
            ("SH_DEGREE_0_COEF_0", "<f4", 3),
        ],
    )
    for name in rows.dtype.names:
        if name != "pad":
            full = name if name == "POSITION" else f"{EXTENSION}:{name}"
            values = attribute(document, binary, full)
            greatest = {"ROTATION": 32767, "OPACITY": 65535}.get(name, 1)
            rows[name] = (values * greatest).round().squeeze() if greatest > 1 else values
            accessor = document["accessors"][primitive(document)["attributes"][full]]
            accessor |= {"bufferView": 0, "byteOffset": rows.dtype.fields[name][1]}
            accessor |= {"ROTATION": {"componentType": SHORT}, "OPACITY": {"componentType": USHORT}}.get(name, {})
            accessor["normalized"] = greatest > 1
    del primitive(document)["attributes"]["COLOR_0"]
    binary = bytes(8) + rows.tobytes()
    document["bufferViews"] = [{"buffer": 0, "byteOffset": 8, "byteLength": rows.nbytes, "byteStride": rows.itemsize}]
    document["buffers"] = [{"byteLength": len(binary)}]
    write(tmp_path / "b.glb", document, binary)
    lost = errors(splats, load_splats(tmp_path / "b.glb"))
    assert lost.means == lost.sh0 == 0
    assert lost.opacities <= 1 / 65535
    assert lost.quats <= 2 / 32767


def test_signed_bytes_end_at_minus_one(tmp_path: Path) -> None:
    splats = make_splats(1, degree=0)
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")
    accessor = document["accessors"][primitive(document)["attributes"][f"{EXTENSION}:ROTATION"]]
    accessor |= {"componentType": BYTE, "normalized": True}
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    write(tmp_path / "b.glb", document, binary[:offset] + struct.pack("4b", 127, -128, -127, 0) + binary[offset + 4 :])
    assert load_splats(tmp_path / "b.glb").quats.tolist() == [[0, -1, 1, -1]]  # turned around x and y, wxyz


def test_primitives_follow_one_another_at_the_highest_degree(tmp_path: Path) -> None:
    parts = [make_splats(4, degree=1, seed=1), make_splats(3, degree=0, seed=2)]
    for i, part in enumerate(parts):
        save_splats(tmp_path / f"{i}.glb", part)
    (first, binary), (second, more) = parse(tmp_path / "0.glb"), parse(tmp_path / "1.glb")
    accessors, views = len(first["accessors"]), len(first["bufferViews"])
    for view in second["bufferViews"]:
        view["byteOffset"] += len(binary)
    for accessor in second["accessors"]:
        accessor["bufferView"] += views
    attributes = primitive(second)["attributes"]
    primitive(second)["attributes"] = {name: index + accessors for name, index in attributes.items()}
    first["meshes"].append({"primitives": [primitive(second)]})
    first["accessors"] += second["accessors"]
    first["bufferViews"] += second["bufferViews"]
    first["buffers"] = [{"byteLength": len(binary) + len(more)}]
    write(tmp_path / "both.glb", first, binary + more)
    both = parts[0].append(parts[1].with_sh_degree(1))
    assert errors(both, load_splats(tmp_path / "both.glb")).sh1 == 0


def two_parents(document: dict[str, Any]) -> None:
    document["nodes"] = [{"children": [2]}, {"children": [2]}, {"mesh": 0}]


def circle(document: dict[str, Any]) -> None:
    document["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0], "scale": [2, 2, 2]}]


def share(document: dict[str, Any]) -> None:
    document["meshes"][0]["primitives"] *= 50


def set_in(*path: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        target: Any = document
        for key in path[:-1]:
            target = target[key]
        target[path[-1]] = value

    return change


PRIMITIVE = ("meshes", 0, "primitives", 0)
SPLATTING = (*PRIMITIVE, "extensions", EXTENSION)
LIES = {
    "two parents": (two_parents, "two parents"),
    "a circle of nodes": (circle, "circle"),
    "a child that is not there": (set_in("nodes", 0, "children", value=[7]), "numbers of nodes"),
    "a node that shears": (set_in("nodes", 0, "matrix", value=[1, 1, *[0] * 3, 1, *[0] * 4, 1, *[0] * 4, 1]), "shears"),
    "uneven scales": (set_in("nodes", 0, "scale", value=[1, 2, 1]), "differently"),
    "no scale": (set_in("nodes", 0, "scale", value=[0, 0, 0]), "differently"),
    "an infinite move": (set_in("nodes", 0, "translation", value=[1e400, 0, 0]), "finite"),
    "no rotation": (set_in("nodes", 0, "rotation", value=[0, 0, 0, 0]), "quaternion"),
    "shared positions": (share, "share their bytes"),
    "another color": (set_in(*SPLATTING, "colorSpace", value="srgb_p3_display"), "colorSpace"),
    "another kernel": (set_in(*SPLATTING, "kernel", value="triangle"), "kernel"),
    "compressed": (set_in(*SPLATTING, "extensions", value={"X_spz": {}}), "compressed"),
    "an unknown extension": (set_in("extensionsRequired", value=["X_y"]), "X_y"),
    "no splats": (set_in(*PRIMITIVE, "extensions", value={}), "holds no splats"),
    "missing positions": (set_in(*PRIMITIVE, "attributes", value={}), "POSITION must have"),
    "half a degree": (
        lambda root: root["meshes"][0]["primitives"][0]["attributes"].pop(f"{EXTENSION}:SH_DEGREE_1_COEF_1"),
        "COEF_1 must have",
    ),
    "shared bytes": (set_in(*PRIMITIVE, "attributes", f"{EXTENSION}:SH_DEGREE_2_COEF_0", value=0), "share their bytes"),
    "a huge count": (set_in("accessors", 0, "count", value=10**12), "claims 1000000000000"),
    "a negative count": (set_in("accessors", 0, "count", value=-1), ">= 0"),
    "no count": (set_in("accessors", 0, "count", value=0), "do not fit"),
    "a view past the end": (set_in("bufferViews", 0, "byteLength", value=10**9), "do not fit"),
    "a view far out": (set_in("bufferViews", 0, "byteOffset", value=10**15), "do not fit"),
    "a last element past its view": (set_in("bufferViews", 0, "byteLength", value=4 * 12 - 1), "claims 4 elements"),
    "no stride": (set_in("bufferViews", 0, "byteStride", value=0), "do not fit"),
    "another file": (set_in("buffers", 0, "uri", value="http://x"), "own binary chunk"),
    "another buffer": (set_in("bufferViews", 0, "buffer", value=1), "own binary chunk"),
    "sparse": (set_in("accessors", 0, "sparse", value={}), "sparse"),
    "a string for a list": (set_in("accessors", value="x"), "list of objects"),
    "an index out of range": (set_in(*PRIMITIVE, "attributes", "POSITION", value=999), "item 999"),
    "a bool for an index": (set_in(*PRIMITIVE, "attributes", "POSITION", value=True), "integer"),
    "an unknown type": (set_in("accessors", 0, "type", value="MAT4"), "numbers or vectors"),
    "an unknown component": (set_in("accessors", 0, "componentType", value=5125), "numbers or vectors"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_document_that_lies_is_refused(tmp_path: Path, lie: str) -> None:
    save_splats(tmp_path / "a.glb", make_splats(4, degree=1))
    document, binary = parse(tmp_path / "a.glb")
    change, message = LIES[lie]
    change(document)
    write(tmp_path / "b.glb", document, binary)
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "b.glb")


@pytest.mark.parametrize(("name", "value", "message"), [("SCALE", -1, "early draft"), ("OPACITY", 1.5, r"\[0, 1\]")])
def test_values_out_of_range_are_refused(tmp_path: Path, name: str, value: float, message: str) -> None:
    save_splats(tmp_path / "a.glb", make_splats(4, degree=0))
    document, binary = parse(tmp_path / "a.glb")
    accessor = document["accessors"][primitive(document)["attributes"][f"{EXTENSION}:{name}"]]
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    write(tmp_path / "b.glb", document, binary[:offset] + struct.pack("<f", value) + binary[offset + 4 :])
    with pytest.raises(InputError, match=message):
        load_splats(tmp_path / "b.glb")


def many_accessors(document: dict[str, Any], count: int) -> None:
    """`count` primitives, and as many accessors, that hold one splat each."""
    document["accessors"] = [{**accessor, "count": 1} for accessor in document["accessors"]]
    document["accessors"] += [{"bufferView": 0, "componentType": FLOAT, "count": 1, "type": "VEC3"}] * count
    document["meshes"][0]["primitives"] *= count


def many_nodes(document: dict[str, Any], count: int) -> None:
    """A chain of `count` nodes and as many meshes."""
    document["nodes"] = [{"mesh": i, "children": [i + 1]} for i in range(count)] + [{}]
    document["accessors"] = [{**accessor, "count": 1} for accessor in document["accessors"]]
    document["meshes"] *= count


def calls_to_load(path: Path) -> int:
    """Number of function calls and returns, of Python and of C, while a file is read."""
    events = 0

    def count(*_: object) -> None:
        nonlocal events
        events += 1

    sys.setprofile(count)
    load_splats(path)
    sys.setprofile(None)
    return events


@pytest.mark.parametrize("change", [many_accessors, many_nodes])
def test_the_work_is_linear_in_the_number_of_primitives_and_nodes(
    tmp_path: Path, change: Callable[[dict[str, Any], int], None]
) -> None:
    save_splats(tmp_path / "a.glb", make_splats(400, degree=0))
    calls = []
    for count in (200, 400):
        document, binary = parse(tmp_path / "a.glb")
        change(document, count)
        write(tmp_path / "b.glb", document, binary)
        calls.append(calls_to_load(tmp_path / "b.glb"))
    assert calls[1] < 2.2 * calls[0]


@pytest.mark.parametrize("text", [b"[" * 100_000, b'{"a":', b"[]   ", b"\xff\xfe  ", b"1" * 5000])
def test_broken_json_is_refused(tmp_path: Path, text: bytes) -> None:
    chunk = struct.pack("<I4s", len(text), b"JSON") + text
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    with pytest.raises(InputError):
        load_splats(tmp_path / "a.glb")


def test_endless_json_is_not_parsed(tmp_path: Path) -> None:
    chunk = struct.pack("<I4s", 5 << 20, b"JSON") + b" " * (5 << 20)
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunk)) + chunk)
    with pytest.raises(InputError, match="JSON may have"):
        load_splats(tmp_path / "a.glb")


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.glb", make_splats(2, degree=0))
    data = (tmp_path / "a.glb").read_bytes()
    for size in range(0, len(data), 11):
        (tmp_path / "b.glb").write_bytes(data[:size])
        with pytest.raises(InputError):
            load_splats(tmp_path / "b.glb")


def test_meshes_are_no_splats(shared_data: Path) -> None:
    files = sorted(shared_data.glob("meshes/misc_glb/*.glb"))
    assert files
    for file in files:
        with pytest.raises(InputError, match="splats"):
            load_splats(file)


def test_a_file_beyond_the_limit_is_refused_before_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_splats(tmp_path / "a.glb", make_splats(9))
    size = (tmp_path / "a.glb").stat().st_size
    monkeypatch.setattr(gltf, "_MAX_SIZE", size - 1)  # 4 GiB less 1 in earnest
    with pytest.raises(InputError, match=f"holds {size - 1} bytes, got {size}"):
        save_splats(tmp_path / "b.glb", make_splats(9))
    assert not (tmp_path / "b.glb").exists()


def color_of(path: Path, direction: torch.Tensor) -> torch.Tensor:
    splats = load_splats(path)
    return sh.evaluate(splats.sh0, splats.shN, direction.expand(len(splats), 3), 3)


def test_nodes_turn_scale_and_move_splats_and_what_is_seen_of_them(tmp_path: Path) -> None:
    """A parent turns a quarter about y and doubles, a child moves first: all but the frame stays the same."""
    save_splats(tmp_path / "a.glb", make_splats(30))
    document, binary = parse(tmp_path / "a.glb")
    half = 0.5**0.5
    document["nodes"] = [
        {"children": [1], "rotation": [0, half, 0, half], "scale": [2, 2, 2]},
        {"mesh": 0, "translation": [1, 0, 0]},
    ]
    write(tmp_path / "b.glb", document, binary)
    before, after = load_splats(tmp_path / "a.glb"), load_splats(tmp_path / "b.glb")
    flip = torch.diag(torch.tensor([-1.0, -1, 1]))
    quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    moved = before.means @ flip + torch.tensor([1.0, 0, 0])
    torch.testing.assert_close(after.means, 2 * moved @ quarter.T @ flip, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.log_scales, before.log_scales + math.log(2), atol=1e-5, rtol=0)
    turn = flip @ quarter @ flip
    torch.testing.assert_close(covariances(after) / 4, turn @ covariances(before) @ turn.T, atol=1e-4, rtol=1e-4)
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
    seen = color_of(tmp_path / "b.glb", turn @ direction)
    torch.testing.assert_close(seen, color_of(tmp_path / "a.glb", direction), atol=1e-4, rtol=0)


def covariances(splats: Gaussians) -> torch.Tensor:
    root = rotation_matrices(splats.quats) * splats.scales[:, None]
    return root @ root.transpose(1, 2)


def test_a_mesh_under_two_nodes_comes_twice(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.glb", make_splats(5))
    document, binary = parse(tmp_path / "a.glb")
    document["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 3]}]
    write(tmp_path / "b.glb", document, binary)
    means = load_splats(tmp_path / "b.glb").means
    torch.testing.assert_close((means[:5] - means[5:]).abs(), torch.tensor([[0.0, 0, 3]]).expand(5, 3))


def test_points_have_linear_color(tmp_path: Path) -> None:
    """A viewer that does not know the extension shows COLOR_0, which glTF reads as linear light."""
    splats = make_splats(1, degree=0)
    splats.sh0[0, 0] = sh.sh0_from_rgb(torch.tensor([0.5, 0.0, 1.0]))
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")
    accessor = document["accessors"][primitive(document)["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["normalized"]) == (USHORT, True)
    offset = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    color = np.frombuffer(binary, "<u2", 4, offset) / 65535
    assert color[:3].tolist() == pytest.approx([0.21404, 0, 1], abs=1e-4)


def test_the_coding_of_srgb_is_that_of_the_standard() -> None:
    """IEC 61966-2-1: a line for the dark values, a power for the rest."""
    linear = torch.tensor([0.0, 0.001, 0.003, 0.0031308, 0.004, 0.21404, 1.0])
    coded = torch.tensor([0.0, 0.01292, 0.03876, 0.04045, 0.05071, 0.5, 1.0])
    torch.testing.assert_close(srgb_from_linear(linear), coded, atol=2e-5, rtol=0)
    torch.testing.assert_close(linear_from_srgb(coded), linear, atol=2e-5, rtol=0)


def test_splats_of_linear_color_are_coded(tmp_path: Path) -> None:
    """The base color exactly; the change with the direction to first order."""
    splats = make_splats(40, degree=1)
    splats.sh0[:] = sh.sh0_from_rgb(torch.rand(40, 1, 3, generator=torch.manual_seed(2)) * 0.6 + 0.2)
    splats.shN[:] *= 0.01
    save_splats(tmp_path / "a.glb", splats)
    document, binary = parse(tmp_path / "a.glb")
    set_in(*SPLATTING, "colorSpace", value="lin_rec709_display")(document)
    write(tmp_path / "b.glb", document, binary)
    direction = torch.tensor([0.0, 0.6, 0.8])
    coded = srgb_from_linear(color_of(tmp_path / "a.glb", direction))
    torch.testing.assert_close(color_of(tmp_path / "b.glb", direction), coded, atol=2e-3, rtol=0)
    torch.testing.assert_close(linear_from_srgb(coded), color_of(tmp_path / "a.glb", direction), atol=1e-5, rtol=0)
