"""Photos as strangers take them: what is read, what is refused, and with which words."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import textured_room as room
from PIL import Image

from gsopt.data.sfm import photos
from gsopt.data.sfm.masks import prepare_masks
from gsopt.data.sfm.photos import find_photos, read_photos
from gsopt.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    room.photograph(tmp_path / "given", room.arc(3))
    return tmp_path / "given"


def broken(kind: str, good: Path) -> tuple[str, bytes]:
    """Name and content of one unusable file."""
    jpeg = good.read_bytes()
    return {
        "cut off": ("cut.jpg", jpeg[: len(jpeg) // 2]),
        "garbled header": ("bad.jpg", b"\xff\xd8" + bytes(200)),
        "no image": ("letter.png", b"Dear sir or madam,\n" * 20),
        "empty": ("void.jpg", b""),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("cut off", "cannot be decoded"),
        ("garbled header", "is no image, whatever its name says"),
        ("no image", "is no image, whatever its name says"),
        ("empty", r"is empty \(0 bytes\)"),
    ],
)
def test_a_broken_file_is_named_and_the_rest_goes_on(folder: Path, tmp_path: Path, kind: str, words: str) -> None:
    name, content = broken(kind, folder / "room_00.jpg")
    (folder / name).write_bytes(content)
    read, refused = read_photos(find_photos(folder), tmp_path)
    assert [photo.name for photo in read] == ["room_00.jpg", "room_01.jpg", "room_02.jpg"]
    assert [item.name for item in refused] == [name]
    assert re.search(words, refused[0].reason)


def test_heic_without_a_decoder_says_what_to_install(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(photos, "_reads_heic", lambda: False)
    (folder / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    _, refused = read_photos(find_photos(folder), tmp_path)
    assert [item.reason for item in refused] == [
        "HEIC needs a decoder: pip install 'gsopt[heic]', or export the photo as JPEG"
    ]


def test_copies_are_left_out_re_encoded_or_not(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "room_00.jpg", folder / "room_00 (copy).jpg")
    with Image.open(folder / "room_01.jpg") as image:
        image.save(folder / "sent.jpg", quality=60)
    read, refused = read_photos(find_photos(folder), tmp_path)
    assert len(read) == 3
    assert all("a copy of" in item.reason for item in refused)
    assert len(refused) == 2


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_stored_in_any_orientation_is_turned_upright(tmp_path: Path, orientation: int) -> None:
    upright = room.draw(room.arc(1)[0])
    undo = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # Pillow's Transpose members that undo what the tag asks for
    stored = upright if orientation == 1 else upright.transpose(Image.Transpose(undo[orientation]))
    (tmp_path / "in").mkdir()
    exif = room.focal_exif()
    exif[0x112] = orientation
    stored.save(tmp_path / "in" / "a.png", exif=exif)
    (photo,), _ = read_photos(find_photos(tmp_path / "in"), tmp_path)
    with Image.open(photo.path) as image:
        assert image.getexif().get(0x112, 1) == 1
        np.testing.assert_array_equal(np.asarray(image), np.asarray(upright))
    assert photo.focal == pytest.approx(room.FOCAL, rel=0.02)


def test_the_focal_length_of_exif_is_that_of_the_diagonal() -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 43  # about the diagonal of 35 mm film
    focal = photos.focal_from_exif(exif, (3000, 4000))
    assert focal == pytest.approx(5000 * 43 / math.hypot(36, 24))
    exif.get_ifd(0x8769)[0xA405] = 0
    assert photos.focal_from_exif(exif, (3000, 4000)) is None


def test_cameras_are_told_apart_by_size_and_zoom(folder: Path, tmp_path: Path) -> None:
    with Image.open(folder / "room_02.jpg") as image:
        image.resize((320, 240)).save(folder / "room_02.jpg", exif=room.focal_exif())
    read, _ = read_photos(find_photos(folder), tmp_path)
    assert read[0].camera == read[1].camera != read[2].camera


def test_names_that_collide_or_hold_blanks_become_unique(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for index, name in enumerate(("a b.jpg", "a_b.jpg", "A_B.jpeg", "10.jpg", "9.jpg")):
        room.draw(room.arc(5)[index]).save(tmp_path / "in" / name)
    read, _ = read_photos(find_photos(tmp_path / "in"), tmp_path)
    names = [photo.name for photo in read]
    assert names[:2] == ["9.jpg", "10.jpg"]
    assert len({name.lower() for name in names}) == 5
    assert not any(" " in name for name in names)


def test_blur_lowers_sharpness_and_contrast_alone_does_not(folder: Path) -> None:
    with Image.open(folder / "room_00.jpg") as image:
        gray = image.convert("L")
    dim = gray.point(lambda value: value // 2)
    small = gray.resize((50, 38)).resize(gray.size, Image.Resampling.BICUBIC)
    assert photos.sharpness(small) < 0.1 * photos.sharpness(gray)
    assert photos.sharpness(dim) == pytest.approx(photos.sharpness(gray), rel=0.05)


def test_a_folder_without_photos_says_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none here")
    with pytest.raises(InputError, match=r"holds no photos. Looked for \.jpg"):
        find_photos(tmp_path)


def test_masks_are_asked_for_and_missed_with_words(folder: Path, tmp_path: Path) -> None:
    read, _ = read_photos(find_photos(folder), tmp_path)
    assert prepare_masks("auto", folder, read, tmp_path / "a").kind == "none"
    with pytest.raises(InputError, match="names no folder"):
        prepare_masks("nowhere", folder, read, tmp_path / "b")
    (tmp_path / "c").mkdir()
    with pytest.raises(InputError, match="`--masks alpha` needs photos with transparency, got 3 without"):
        prepare_masks("alpha", folder, read, tmp_path / "c")
    (tmp_path / "empty").mkdir()
    (tmp_path / "d").mkdir()
    with pytest.raises(InputError, match="has a mask for none of the 3 photos"):
        prepare_masks(str(tmp_path / "empty"), folder, read, tmp_path / "d")


def test_a_photo_of_50_megapixels_is_read(tmp_path: Path) -> None:
    tmp_path.joinpath("photos").mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (362, 543, 3), dtype=np.uint8)
    Image.fromarray(noise).resize((8688, 5792)).save(tmp_path / "photos" / "large.jpg", quality=60)
    found, refused = photos.read_photos(photos.find_photos(tmp_path / "photos"), tmp_path / "work")
    assert refused == []
    assert (found[0].width, found[0].height) == (8688, 5792)


@pytest.mark.parametrize("white", [1, 2, 200, 255])
def test_masks_of_a_folder_keep_their_grays_and_masks_of_0_and_1_become_white(
    folder: Path, tmp_path: Path, white: int
) -> None:
    read, _ = read_photos(find_photos(folder), tmp_path)
    given = np.zeros((read[0].height, read[0].width), np.uint8)
    given[: read[0].height // 2] = white
    for photo in read:
        Image.fromarray(given).save(tmp_path / f"{photo.source.stem}.png")
    (tmp_path / "work").mkdir()
    found = prepare_masks(str(tmp_path), folder, read, tmp_path / "work")
    assert (found.kind, found.unmasked) == ("folder", [])
    assert found.masks is not None
    with Image.open(found.masks / f"{read[0].name}.png") as mask:
        assert np.array_equal(np.asarray(mask), given * (255 if white == 1 else 1))


@pytest.mark.parametrize("choice", ["auto", "alpha"])
def test_alpha_becomes_masks_and_what_it_hides_becomes_gray(folder: Path, tmp_path: Path, choice: str) -> None:
    with Image.open(folder / "room_00.jpg") as image:
        cut = image.convert("RGBA")
    alpha = Image.new("L", cut.size, 255)
    alpha.paste(0, (0, 0, 100, cut.height))
    alpha.paste(128, (100, 0, 110, cut.height))
    cut.putalpha(alpha)
    (folder / "room_00.jpg").unlink()
    cut.save(folder / "room_00.png")
    read, _ = read_photos(find_photos(folder), tmp_path)
    (tmp_path / "work").mkdir()
    found = prepare_masks(choice, folder, read, tmp_path / "work")
    assert (found.kind, found.unmasked) == ("alpha", ["room_01.jpg", "room_02.jpg"])
    assert found.masks is not None
    assert [path.name for path in found.masks.iterdir()] == ["room_00.png.png"]
    with Image.open(found.masks / "room_00.png.png") as mask:
        assert np.array_equal(np.asarray(mask), np.asarray(alpha))
    assert sorted(path.name for path in found.photos.iterdir()) == ["room_00.png", "room_01.jpg", "room_02.jpg"]
    with Image.open(found.photos / "room_00.png") as opaque:
        shown = np.asarray(opaque)
    assert shown.shape[2] == 3
    assert (shown[:, :100] == 128).all()
    assert np.array_equal(shown[:, 110:], np.asarray(cut)[:, 110:, :3])
    between = (np.asarray(cut)[:, 100:110, :3].astype(int) + 128) / 2
    assert np.abs(shown[:, 100:110] - between).max() <= 2
    assert (found.photos / "room_01.jpg").read_bytes() == (folder / "room_01.jpg").read_bytes()
