"""Masks for feature extraction: which are taken, and from where."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm.masks import mask_folder, prepare_masks
from gsopt.data.sfm.photos import Photo
from gsopt.errors import InputError

SIZE = (4, 3)


def photo(work: Path, name: str, alpha: np.ndarray | None = None) -> Photo:
    """A red photo in the working folder, with this alpha."""
    (work / "photos").mkdir(exist_ok=True)
    path = work / "photos" / name
    red = np.full((SIZE[1], SIZE[0], 3), (250, 0, 10), dtype=np.uint8)
    Image.fromarray(red if alpha is None else np.dstack([red, alpha])).save(path)
    thumbnail = np.zeros((32, 32), dtype=np.float32)
    return Photo(name, Path("taken") / name, path, *SIZE, "camera", None, 1.0, alpha is not None, thumbnail)


def levels(value: int) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0]), value, dtype=np.uint8)


def stored(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.mark.parametrize(
    ("choice", "own", "alpha", "kind"),
    [
        ("auto", True, True, "folder"),
        ("auto", True, False, "folder"),
        ("auto", False, True, "alpha"),
        ("auto", False, False, "none"),
        ("alpha", True, True, "alpha"),
        ("none", True, True, "none"),
        ("none", True, False, "none"),
        ("others", True, True, "folder"),
    ],
)
def test_a_folder_of_masks_goes_before_alpha_where_nothing_else_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choice: str, own: bool, alpha: bool, kind: str
) -> None:
    """Folders that are called like the other choices change nothing."""
    source, work = tmp_path / "source", tmp_path / "work"
    for folder in (source, work, tmp_path / "others", tmp_path / "alpha", tmp_path / "none"):
        folder.mkdir()
    monkeypatch.chdir(tmp_path)
    Image.fromarray(levels(200)).save(tmp_path / "others" / "a.png")
    if own:
        (source / "masks").mkdir()
        Image.fromarray(levels(100)).save(source / "masks" / "a.png")
    photos = [photo(work, "a.png", levels(50) if alpha else None), photo(work, "b.png")]
    found = prepare_masks(choice, source, photos, work)
    assert found.kind == kind
    assert found.photos == work / ("opaque" if alpha else "photos")
    assert found.masks == (None if kind == "none" else work / "masks")
    assert found.unmasked == ([] if kind == "none" else ["b.png"])
    if found.masks is not None:
        value = 50 if kind == "alpha" else 200 if choice == "others" else 100
        assert [path.name for path in found.masks.iterdir()] == ["a.png.png"]
        assert stored(found.masks / "a.png.png").tolist() == levels(value).tolist()


def test_a_mask_of_another_size_takes_that_of_its_photo(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    large = np.zeros((2 * SIZE[1], 2 * SIZE[0]), dtype=np.uint8)
    large[: SIZE[1]] = 255
    Image.fromarray(large).save(tmp_path / "masks" / "a.png")
    prepare_masks("auto", tmp_path, [photo(tmp_path, "a.png")], tmp_path / "masks")
    written = stored(tmp_path / "masks" / "masks" / "a.png.png")
    assert (written.shape, written[0].tolist(), written[2].tolist()) == ((SIZE[1], SIZE[0]), [255] * 4, [0] * 4)


def test_masks_that_fit_no_photo_and_photos_without_alpha_are_refused(tmp_path: Path) -> None:
    (tmp_path / "masks").mkdir()
    photos = [photo(tmp_path, "a.png"), photo(tmp_path, "b.png")]
    for number, (choice, answer) in enumerate(
        [
            ("auto", "has a mask for none of the 2 photos"),
            ("alpha", "needs photos with transparency, got 2 without"),
            (str(tmp_path / "absent"), "names no folder"),
        ]
    ):
        work = tmp_path / str(number)
        work.mkdir()
        with pytest.raises(InputError, match=answer):
            prepare_masks(choice, tmp_path, photos, work)


def test_a_home_folder_may_be_written_with_a_tilde(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "mine").mkdir()
    assert mask_folder("~/mine", Path("elsewhere")) == tmp_path / "mine"
    assert mask_folder("~/yours", Path("elsewhere")) is None
