"""Meshes to solid voxels, and folders of them to one file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from meshes import library_folder, listed, slab, table, tower, write_boxes

from gsopt.errors import InputError
from gsopt.shape_library.entry import SIDE
from gsopt.shape_library.meshes import mesh_points
from gsopt.shape_library.meshes.build import Built, build_library
from gsopt.shape_library.meshes.mesh_list import find_meshes
from gsopt.shape_library.meshes.mesh_points import read_points
from gsopt.shape_library.meshes.voxelize import FINE_SIDE, open_air, voxelized


def built(meshes: Path, out: Path, workers: int = 1) -> tuple[Built, list[str]]:
    lines: list[str] = []
    return build_library(meshes, out, workers, lines.append), lines


def test_a_box_fills_its_box(tmp_path: Path) -> None:
    shape = voxelized(read_points(write_boxes(tmp_path / "tower.obj", tower()), FINE_SIDE))
    assert shape.occupied.mean() > 0.999
    np.testing.assert_allclose(shape.sizes, [0.3, 0.3, 1.0], atol=1e-6)


def test_a_box_without_a_floor_is_solid_because_things_stand_on_the_ground(tmp_path: Path) -> None:
    path = write_boxes(tmp_path / "tent.obj", [((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))], open_below=True)
    assert voxelized(read_points(path, FINE_SIDE)).occupied.mean() > 0.99


def test_there_is_air_below_a_table(tmp_path: Path) -> None:
    occupied = voxelized(read_points(write_boxes(tmp_path / "table.obj", table()), FINE_SIDE)).occupied
    middle = SIDE // 2
    assert not occupied[middle, middle, : SIDE // 2].any()
    assert occupied[:, :, -2].mean() > 0.95
    assert occupied.mean() == pytest.approx((2.0 * 1.4 * 0.2 + 4 * 0.24 * 0.24 * 0.8) / (2.0 * 1.4 * 1.0), rel=0.25)


def test_light_from_above_reaches_into_a_cup_and_not_into_a_closed_shell() -> None:
    shell = np.zeros((12, 12, 12), bool)
    shell[2:10, 2:10, 2:10] = True
    shell[3:9, 3:9, 3:9] = False
    assert not open_air(shell)[4:8, 4:8, 4:8].any()
    shell[:, :, 9] = False
    assert open_air(shell)[4:8, 4:8, 6:8].all()


def test_the_axis_that_points_up_can_be_named(tmp_path: Path) -> None:
    path = write_boxes(tmp_path / "tower.obj", tower())
    lying = voxelized(read_points(path, FINE_SIDE, "z"))
    np.testing.assert_allclose(lying.sizes, [0.3, 1.0, 0.3], atol=1e-6)


def test_colors_of_vertices_reach_the_cells(tmp_path: Path) -> None:
    path = tmp_path / "two.ply"
    header = "ply\nformat ascii 1.0\nelement vertex 8\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    header += "element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x} {y} {z} {'250 0 0' if z < 0 else '0 0 250'}" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    faces = ("0 1 3 2", "4 6 7 5", "0 4 5 1", "2 3 7 6", "0 2 6 4", "1 5 7 3")
    path.write_text(header + "\n".join([*rows, *(f"4 {face}" for face in faces)]) + "\n")
    colors = voxelized(read_points(path, FINE_SIDE)).colors
    assert tuple(colors[5, 5, 0]) == (250, 0, 0)
    assert tuple(colors[5, 5, -1]) == (0, 0, 250)


def test_names_come_from_paths_texts_and_shapenets_taxonomy(tmp_path: Path) -> None:
    folder = library_folder(tmp_path / "meshes")
    write_boxes(folder / "03001627" / "1a6f615e8b1b5ae4" / "models" / "model_normalized.obj", tower())
    (folder / "taxonomy.json").write_text('[{"synsetId": "03001627", "name": "chair,seat"}]')
    entries = {source.entry.id: source.entry for source in find_meshes(folder)}
    assert entries["tables/oak_table"].name == "oak table"
    assert entries["tables/oak_table"].category == "tables"
    assert entries["0f3a"].words == "a street sign"
    assert "chair" in entries["03001627/1a6f615e8b1b5ae4/models/model_normalized"].category


def test_broken_meshes_are_skipped_named_and_counted(tmp_path: Path) -> None:
    folder = library_folder(tmp_path / "meshes")
    (folder / "empty.obj").write_text("")
    (folder / "text.glb").write_text("no mesh at all")
    (folder / "cut.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n")
    (folder / "lost.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (folder / "endless.obj").write_text("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    result, lines = built(folder, tmp_path / "out.safetensors")
    assert (result.entries, result.skipped) == (3, 6)
    for name in ("empty", "text", "cut", "lost", "endless", "point"):
        assert any(line.startswith(f"skipped {name}: ") for line in lines), name


def test_a_library_of_broken_meshes_only_is_refused_and_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "one.obj").write_text("v 0 0\n")
    with pytest.raises(InputError, match="None of the 1 meshes"):
        built(tmp_path / "meshes", tmp_path / "out.safetensors")
    assert not (tmp_path / "out.safetensors").exists()


def test_the_same_meshes_give_the_same_bytes_for_any_number_of_workers(tmp_path: Path) -> None:
    folder = library_folder(tmp_path / "meshes")
    built(folder, tmp_path / "one.safetensors")
    built(folder, tmp_path / "two.safetensors", workers=2)
    assert (tmp_path / "one.safetensors").read_bytes() == (tmp_path / "two.safetensors").read_bytes()


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_boxes(tmp_path / "slab.obj", slab())
    monkeypatch.setattr(mesh_points, "MAX_BYTES", 10)
    with pytest.raises(InputError, match="must hold 1 to 10 bytes"):
        read_points(path, FINE_SIDE)


@pytest.mark.parametrize(
    ("rows", "wrong"),
    [
        ([{"name": "no mesh"}], "no object with `mesh`"),
        ([3], "no object with `mesh`"),
        ([{"mesh": "a.obj", "up": "x"}], "not y or z"),
        ([{"mesh": "a.obj"}, {"mesh": "b/a.obj"}], "two meshes called 'a'"),
        ([], "has 0 meshes"),
    ],
)
def test_a_list_that_is_wrong_says_where(tmp_path: Path, rows: list[dict[str, object]], wrong: str) -> None:
    with pytest.raises(InputError, match=wrong):
        find_meshes(listed(tmp_path, rows))


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "mine"
    out.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        built(library_folder(tmp_path / "meshes"), out)
    assert out.read_text() == "mine"


def test_the_mesh_files_of_a_folder_of_ten_thousand_are_all_listed(tmp_path: Path) -> None:
    for number in range(10_000):
        (tmp_path / f"chair_{number:05d}.obj").touch()
    sources = find_meshes(tmp_path)
    assert len(sources) == 10_000
    assert sources[17].entry.name == "chair"
