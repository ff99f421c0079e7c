"""File names that are no UTF-8: they are read, written and read again as the bytes they are."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import textured_room as room
from dataset_builders import colmap, nerfstudio, read_document, write_json

from gsopt.data.colmap import read_colmap
from gsopt.data.scene import load_scene
from gsopt.data.sfm.photos import find_photos, read_photos
from gsopt.data.sfm.placement import Similarity
from gsopt.data.sfm.write_scene import transforms
from gsopt.errors import InputError
from gsopt.events import to_json

LATIN = b"\xe9t\xe9"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with such a name; skipped where the file system has none."""
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN))
    try:
        path.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 alone")
    return path


def renamed(path: Path) -> Path:
    target = path.with_name(os.fsdecode(LATIN) + path.suffix)
    path.rename(target)
    return target


def test_transforms_may_name_such_a_file(folder: Path) -> None:
    image = renamed(nerfstudio(folder) / "images" / "003.png")
    document = read_document(folder)
    for frame in document["frames"]:
        frame["file_path"] = frame["file_path"].replace("003.png", image.name)
    write_json(folder, document)
    views = {view.name: view for view in load_scene(folder).train}
    assert len(views) == 10
    assert views[f"images/{image.name}"].pixels().shape == (16, 16, 3)
    image.write_bytes(b"")
    with pytest.raises(InputError, match=r"is not a readable file|Cannot decode"):
        load_scene(folder)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_a_reconstruction_may_name_such_a_file_and_its_json_reads_back(folder: Path, suffix: str) -> None:
    image = renamed(colmap(folder, suffix=suffix) / "images" / "im 003.png")
    model = folder / "sparse" / "0" / f"images{suffix}"
    model.write_bytes(model.read_bytes().replace(b"im 003.png", os.fsencode(image.name)))
    before = {view.name: view.camera.viewmats for view in load_scene(folder).train}
    assert f"images/{image.name}" in before
    (folder / "transforms.json").write_bytes(to_json(transforms(read_colmap(folder).frames, Similarity.identity())))
    assert f"images/{image.name}" in {frame["file_path"] for frame in read_document(folder)["frames"]}
    model.unlink()
    (folder / "transforms.json").write_text(json.dumps({**read_document(folder), "ply_file_path": None}))
    after = {view.name: view.camera.viewmats for view in load_scene(folder).train}
    assert after.keys() == before.keys()
    assert all(after[name].allclose(before[name], atol=1e-6) for name in before)


def test_photos_of_such_names_get_one_that_every_tool_takes(folder: Path, tmp_path: Path) -> None:
    room.photograph(folder, room.arc(3))
    source = renamed(folder / "room_01.jpg")
    photos, refused = read_photos(find_photos(folder), tmp_path / "work")
    assert refused == []
    (photo,) = [photo for photo in photos if photo.source == source]
    assert photo.name.isascii()
    assert photo.path.read_bytes() == source.read_bytes()
