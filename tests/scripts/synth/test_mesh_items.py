"""Meshes are found and named, and bad files are refused before Blender opens them. No Blender."""

from __future__ import annotations

import json
import math
import os
import struct
from pathlib import Path
from typing import Any

import pytest
from synth import mesh_items
from synth.categories import SHAPENET
from synth.mesh_items import Item
from synth.meshfile import MAX_BYTES, check_mesh, find_near

from gsopt.errors import InputError


def test_a_folder_gives_every_mesh_below_it(tmp_path: Path) -> None:
    for name in ("b.OBJ", "sub/a.glb", "sub/deep/c.stl", "sub/notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("x")
    assert [item.id for item in mesh_items.of_paths([tmp_path])] == ["b", "sub/a", "sub/deep/c"]
    for name in ("b.glb", "sub.ply"):  # would be the second b, and a folder that another object lies in
        (tmp_path / name).write_text("x")
    assert [i.id for i in mesh_items.unique(mesh_items.of_paths([tmp_path]))] == [
        "b.OBJ", "b.glb", "sub/a", "sub/deep/c", "sub.ply"
    ]  # fmt: skip
    void = tmp_path / "void"
    void.mkdir()
    with pytest.raises(InputError, match="no mesh"):
        list(mesh_items.of_paths([void]))


def test_a_folder_that_cannot_be_listed_is_an_input_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        list(mesh_items.of_paths([tmp_path]))
    with pytest.raises(InputError, match="Permission denied"):
        list(mesh_items.of_shapenet(tmp_path, ()))


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("стул № 3", "стул № 3"),
        ("椅子/木", "椅子/木"),
        ("../../etc/passwd", "etc/passwd"),
        ("/abs/x", "abs/x"),
        ("a\\b:c?", "a/b_c_"),
        (".hidden", "hidden"),
        ("..", "object"),
        ("", "object"),
        ("x" * 300, "x" * 150),
    ],
)
def test_ids_are_paths_that_stay_inside(text: str, safe: str) -> None:
    assert mesh_items.safe_id(text) == safe


def test_two_objects_never_share_a_place() -> None:
    same = [Item("Cup", Path("a/cup.obj")), Item("cup", Path("b/cup.obj"))]
    nested = [Item("a", Path("a.obj")), Item("a/b", Path("b.obj"))]
    for clash in (same, nested, []):
        with pytest.raises(InputError):
            mesh_items.unique(clash)
    assert len(mesh_items.unique([Item("a", Path("a")), Item("ab/c", Path("b"))])) == 2


def test_shapenet_knows_its_models(shapenet: Path) -> None:
    (found,) = mesh_items.of_shapenet(shapenet, ())
    assert (found.id, found.category, found.mesh.name) == ("03001627/abc", "chair", "model_normalized.obj")
    assert len(SHAPENET) == 55
    (shapenet / "taxonomy.json").write_text(json.dumps([{"synsetId": "03001627", "name": "throne,chair"}]))
    (found,) = mesh_items.of_shapenet(shapenet, ("03001627",))
    assert found.category == "throne"
    old = shapenet / "02691156" / "xyz"
    old.mkdir(parents=True)
    (old / "model.obj").write_text("x")
    assert [i.mesh.name for i in mesh_items.of_shapenet(shapenet, ())] == ["model.obj", "model_normalized.obj"]
    with pytest.raises(InputError, match="99999999"):
        list(mesh_items.of_shapenet(shapenet, ("99999999",)))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("m.json", '[{"obj": "sub\\\\a.obj", "id": "x/a", "name": "A", "license": "CC0", "tris": 3}]'),
        ("m.json", '{"objects": [{"mesh": "sub/a.obj", "id": "x/a", "name": "A", "license": "CC0"}]}'),
        ("m.jsonl", '{"path": "sub/a.obj", "id": "x/a", "name": "A", "license": "CC0"}\n\n'),
        ("m.csv", "file,id,name,license,category\nsub/a.obj,x/a,A,CC0,\n"),
    ],
)
def test_manifests_of_every_kind_say_the_same(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert list(mesh_items.of_manifest(tmp_path / name)) == [
        Item("x/a", tmp_path / "sub" / "a.obj", name="A", license="CC0"),
    ]


@pytest.mark.parametrize("text", ["", "{", "{}", "3", "[1]", '[{"id": "a"}]', '{"objects": 3}', "[" * 100_000])
def test_a_broken_manifest_is_an_input_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(InputError, match=r"m\.json"):
        list(mesh_items.of_manifest(tmp_path / "m.json"))


# Files


def gltf(count: int, length: int = 36, **more: Any) -> dict[str, Any]:
    return {
        "buffers": [{"byteLength": length}],
        "bufferViews": [{"buffer": 0, "byteLength": length}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count}],
    } | more


def glb(document: dict[str, Any], binary: bytes = bytes(36)) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


PLY = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nend_header\n0\n1\n"
BINARY_PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty uchar red\nproperty float x\nend_header\n"
)
HOLLOW = {"accessors": [{"componentType": 5126, "type": "VEC3", "count": 2_000_000_000}]}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("two_billion.glb", glb(gltf(2_000_000_000))),
        ("zeros.glb", glb(gltf(3, **HOLLOW))),
        ("view.glb", glb(gltf(3, length=4000))),
        ("short.glb", glb(gltf(3))[:-10]),
        ("negative.glb", glb(gltf(-1))),
        ("garbage.glb", b"glTF but not really, and long enough"),
        ("list.glb", glb([])),  # type: ignore[arg-type]
        ("lost.gltf", json.dumps(gltf(3) | {"buffers": [{"byteLength": 36, "uri": "gone.bin"}]}).encode()),
        ("huge.ply", PLY.format(2_000_000_000).encode()),
        ("minus.ply", PLY.format(-1).encode()),
        ("long.ply", PLY.format("9" * 5000).encode()),
        ("words.ply", PLY.format("many").encode()),
        ("huge.stl", bytes(80) + struct.pack("<I", 2_000_000_000) + bytes(50)),
        ("cut.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2"),
        ("cut2.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/"),
        ("cut3.obj", b"v 0 0 0\nv 1 0 "),
        ("past the end.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 4/3\n"),
        ("before the start.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("inf.obj", b"v 1 0 -inf\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("nan.ply", PLY.format(2).replace("\n1\n", "\nnan\n").encode()),
        ("nan.stl", bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, math.nan, 0, 1, 0, 0)),
        ("nan text.stl", b"solid x\n facet normal 0 0 1\n vertex 0 NaN 0\n"),
        ("nan binary.ply", BINARY_PLY + struct.pack("<Bf", 1, math.nan)),
        ("empty.obj", b""),
        ("mesh.txt", b"v 0 0 0"),
    ],
)
def test_what_would_hang_or_mislead_blender_is_refused(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        check_mesh(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("three.glb", glb(gltf(3))),
        (
            "data.gltf",
            json.dumps(gltf(1, length=12) | {"buffers": [{"uri": "data:;base64,AAAAAAAAAAAAAAAA"}]}).encode(),
        ),
        ("fine.ply", PLY.format(2).encode()),
        ("fine.stl", bytes(80) + struct.pack("<I", 1) + bytes(50)),
        ("binary.ply", BINARY_PLY + struct.pack("<Bf", 1, 2.0)),
        ("windows.ply", BINARY_PLY.replace(b"\n", b"\r\n") + struct.pack("<Bf", 0x80, 2.0)),
        ("long.ply", (PLY.format(60_000) + "0.125\n" * 60_000).encode()),  # a search that is not linear takes hours
        ("nancy.obj", b"o nan inf\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"),
        ("text.stl", b"solid x\n facet normal 0 0 1\n"),
        ("negative.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1//9 -2//8 -3//7\n"),
        ("fine.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//1 2//1 3//1\n\n"),
    ],
)
def test_what_holds_what_it_says_passes(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert check_mesh(tmp_path / name) == []


def test_two_gigabytes_are_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "big.obj").open("wb") as file:
        file.truncate(2 * MAX_BYTES)  # sparse: takes no room on the disk
    with pytest.raises(InputError, match="2,147,483,648"):
        check_mesh(tmp_path / "big.obj")


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.obj").mkdir()
    os.mkfifo(tmp_path / "pipe.obj")
    for name in ("absent.obj", "folder.obj", "pipe.obj"):
        with pytest.raises(InputError, match=name):
            check_mesh(tmp_path / name)


def test_a_lost_material_file_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("mtllib my wood.mtl\nv 0 0 0\n")
    assert "my wood.mtl" in check_mesh(tmp_path / "a.obj")[0]
    (tmp_path / "My Wood.mtl").write_text("")
    assert check_mesh(tmp_path / "a.obj") == []


def test_textures_are_found_where_shapenet_keeps_them(shapenet: Path) -> None:
    mesh = next(shapenet.rglob("*.obj"))
    for name in ("../images/Texture0.png", "..\\images\\texture0.png", "C:\\Users\\x\\TEXTURE0.PNG", "texture0.png"):
        found = find_near(mesh, name)
        assert found is not None
        assert found.name == "Texture0.png"
    assert find_near(mesh, "gone.png") is None
    assert find_near(mesh, "") is None
