"""Photos that are read: copies, decoders, sharpness without a scale, and files that others may read."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from test_answers import photo
from test_photo_limits import noise

from gsopt.data.sfm import photos
from gsopt.data.sfm.photos import find_photos, is_copy, natural, read_photos, sharpness


@pytest.mark.parametrize(("apart", "copies"), [(0.99, True), (1.0, False), (1.5, False)])
def test_thumbnails_less_than_one_gray_level_apart_are_of_one_photo(apart: float, copies: bool) -> None:
    """The root mean square counts, not the mean."""
    one = replace(photo("a.jpg"), thumbnail=np.full((32, 32), 100, np.float32))
    other = replace(one, thumbnail=one.thumbnail + np.float32(apart))
    assert is_copy(one, other) == copies
    spike = one.thumbnail.copy()
    spike[0, 0] += np.float32(32 * apart)
    assert is_copy(one, replace(one, thumbnail=spike)) == copies


def test_only_photos_of_one_shape_are_copies() -> None:
    """A photo at half its size is one; a crop to another shape is none."""
    one = photo("a.jpg")
    assert is_copy(one, replace(one, width=one.width // 2, height=one.height // 2))
    assert not is_copy(one, replace(one, width=one.width - 1))
    assert not is_copy(one, replace(one, width=one.height, height=one.width))


def test_a_copy_leaves_the_working_folder_and_names_what_it_copies(tmp_path: Path) -> None:
    """The working folder may lie below one that does not exist yet."""
    first = noise(tmp_path / "in", "a.png")
    second = tmp_path / "in" / "b.png"
    second.write_bytes(first.read_bytes())
    work = tmp_path / "below" / "work"
    found, refused = read_photos([first, second], work)
    assert [one.name for one in found] == ["a.png"]
    assert [(item.name, item.reason) for item in refused] == [("b.png", "a copy of a.png: it adds nothing")]
    assert [path.name for path in (work / "photos").iterdir()] == ["a.png"]


def test_a_photo_that_is_written_anew_may_be_read_by_all(tmp_path: Path) -> None:
    given = noise(tmp_path / "in", "a.bmp")
    before = os.umask(0o077)
    try:
        found = photos.read_photo(given, tmp_path, set())
    finally:
        os.umask(before)
    assert not found.path.is_symlink()
    assert found.path.stat().st_mode & 0o777 == 0o644


def test_sharpness_of_a_checkerboard_is_the_square_of_eight() -> None:
    """Its Laplacian is 8 times its distance from the mean; below a variance of one it counts against one."""
    board = np.indices((20, 30)).sum(0) % 2
    for low, high in ((0, 200), (90, 110), (100, 102)):
        assert sharpness(Image.fromarray(np.where(board, high, low).astype(np.uint8))) == pytest.approx(64)
    assert sharpness(Image.fromarray((100 + board).astype(np.uint8))) == pytest.approx(64 / 4)
    assert sharpness(Image.new("L", (20, 30), 100)) == 0


def test_sharpness_of_a_very_long_photo_can_be_measured() -> None:
    """A strip stays three pixels wide."""
    for size in ((2000, 3), (3, 2000), (6400, 12)):
        assert sharpness(Image.new("L", size, 50)) == 0


def test_large_photos_are_compared_at_640_px() -> None:
    """Stripes of four pixels of a photo of 2560 px are stripes of one pixel then."""
    fine = np.tile(np.arange(640) % 2 * 200, (480, 1)).astype(np.uint8)
    large = np.kron(fine, np.ones((4, 4), np.uint8))
    assert sharpness(Image.fromarray(large)) == pytest.approx(sharpness(Image.fromarray(fine)))
    assert sharpness(Image.fromarray(fine)) == pytest.approx(16, rel=0.01)


@pytest.mark.parametrize("installed", [True, False])
def test_heic_is_read_where_its_decoder_is_installed(installed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    registered: list[bool] = []
    decoder = SimpleNamespace(register_heif_opener=lambda: registered.append(True))
    monkeypatch.setitem(sys.modules, "pillow_heif", decoder if installed else None)
    assert photos._reads_heic() == installed
    assert registered == [True] * installed


def test_numbers_in_names_are_counted_as_numbers(tmp_path: Path) -> None:
    """Hidden files, other files and folders are no photos."""
    names = ["a1.jpg", "a2b3.jpg", "a2b10.jpg", "a10.jpg", "b.jpg"]
    assert sorted(reversed(names), key=natural) == names
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / ".hidden.jpg").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "folder.jpg").mkdir()
    assert [path.name for path in find_photos(tmp_path)] == names
