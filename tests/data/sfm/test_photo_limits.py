"""Limits of a photo's name, of its zoom and of the message about it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import photos
from gsopt.errors import InputError


def noise(folder: Path, name: str, size: tuple[int, int] = (200, 170), mode: str = "RGB", **options: object) -> Path:
    shape = (size[1], size[0]) if mode == "L" else (size[1], size[0], len(mode))
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    folder.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(folder / name, **options)
    return folder / name


def test_names_are_numbered_from_two_on_whatever_their_case() -> None:
    taken: set[str] = set()
    names = [
        photos._scene_name(Path(name), "JPEG", False, taken) for name in ("a b.jpg", "A_B.jpeg", "a_b.JPG", "?.jpg")
    ]
    assert names == ["a_b.jpg", "A_B_2.jpg", "a_b_3.jpg", "_.jpg"]
    assert photos._scene_name(Path("a_b.tif"), "TIFF", False, taken) == "a_b.png"
    assert photos._scene_name(Path("c.webp"), "WEBP", True, taken) == "c.png"
    assert photos._scene_name(Path(".jpg"), "JPEG", False, set()) == ".jpg.jpg"


def test_a_message_of_a_decoder_is_one_line_of_120_characters() -> None:
    assert photos._short(ValueError("x" * 200 + "\nsecond")) == "x" * 120
    assert photos._short(ValueError()) == "ValueError"


def test_the_camera_of_a_photo_is_its_make_size_and_zoom(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker ", " Model"
    exif.get_ifd(0x8769)[0xA405] = 50
    found = photos.read_photo(noise(tmp_path / "in", "a.jpg", exif=exif), tmp_path, set())
    focal = 50 / np.hypot(36, 24) * np.hypot(200, 170)
    assert found.focal == pytest.approx(focal)
    assert found.camera == f"Maker Model 200x170 f {focal:.0f}"
    assert (found.width, found.height, found.has_alpha) == (200, 170, False)
    assert found.thumbnail.shape == (32, 32)
    plain = photos.read_photo(noise(tmp_path / "in", "b.jpg"), tmp_path, set())
    assert (plain.camera, plain.focal) == ("camera 200x170", None)


@pytest.mark.parametrize(("mode", "linked"), [("RGB", True), ("L", True), ("RGBA", True), ("LA", False)])
def test_a_photo_that_every_tool_reads_is_linked_and_others_are_copied(tmp_path: Path, mode: str, linked: bool) -> None:
    found = photos.read_photo(noise(tmp_path / "in", "a.png", mode=mode), tmp_path, set())
    assert found.path.is_symlink() == linked
    assert found.has_alpha == (mode in ("RGBA", "LA"))
    with Image.open(found.path) as image:
        assert image.size == (200, 170)
    assert photos.read_photo(noise(tmp_path / "in", "b.bmp"), tmp_path, set()).path.suffix == ".png"


def test_a_turned_photo_is_copied_upright_with_nearly_all_of_its_detail(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    source = noise(tmp_path / "in", "a.jpg", exif=exif, quality=97, subsampling=0)
    found = photos.read_photo(source, tmp_path, set())
    assert not found.path.is_symlink()
    assert (found.width, found.height) == (170, 200)
    assert found.path.stat().st_mode & 0o777 == 0o644
    with Image.open(found.path) as image, Image.open(source) as original:
        turned = np.asarray(original.rotate(-90, expand=True), float)
        assert np.abs(np.asarray(image, float) - turned).mean() < 4
        assert dict(image.getexif()) == {}


@pytest.mark.parametrize(("kind", "told"), [(".heic", "HEIC needs a decoder"), (".jpg", "is empty")])
def test_a_photo_that_cannot_be_opened_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, told: str
) -> None:
    monkeypatch.setattr(photos, "_reads_heic", lambda: False)
    (tmp_path / f"a{kind}").touch()
    with pytest.raises(InputError, match=told):
        photos._opened(tmp_path / f"a{kind}")


def test_photos_lie_in_a_folder_or_in_its_folder_images(tmp_path: Path) -> None:
    noise(tmp_path / "images", "a10.jpg")
    noise(tmp_path / "images", "a2.JPG")
    noise(tmp_path / "images", ".hidden.jpg")
    assert [path.name for path in photos.find_photos(tmp_path)] == ["a2.JPG", "a10.jpg"]
    noise(tmp_path, "b.png")
    assert [path.name for path in photos.find_photos(tmp_path)] == ["b.png"]


@pytest.mark.parametrize(("orientation", "turned"), [(0, False), (1, False), (2, True), (8, True)])
def test_only_an_orientation_that_turns_makes_a_copy(tmp_path: Path, orientation: int, turned: bool) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    found = photos.read_photo(noise(tmp_path / "in", "a.jpg", exif=exif), tmp_path, set())
    assert found.path.is_symlink() != turned
