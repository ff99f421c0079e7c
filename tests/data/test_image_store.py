"""The image store: bounded, thread-safe, and exact about which file is broken."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import SIZE, save_image
from PIL import Image

from gsopt.data.image_files import MAX_PIXELS
from gsopt.data.images import ImageSource, ImageStore, read_gray, read_header, read_pixels
from gsopt.errors import InputError


def plain(path: Path, mask: Path | None = None, size: int = SIZE) -> ImageSource:
    return ImageSource(path, mask, (SIZE, SIZE), None, size, size)


def test_the_cache_never_exceeds_its_budget_and_drops_the_least_recently_used(tmp_path: Path) -> None:
    side = 512  # 1 MiB of RGBA
    sources = []
    for i in range(4):
        save_image(tmp_path / f"{i}.png", np.full((side, side, 4), i + 1, dtype=np.uint8))
        sources.append(ImageSource(tmp_path / f"{i}.png", None, (side, side), None, side, side))
    store = ImageStore(sources, cache_mb=2)
    first = store.get(0)
    second = store.get(1)
    assert store.get(0) is first
    store.get(2)  # evicts 1
    assert store.cached_bytes == 2 << 20
    assert store.get(0) is first
    assert store.get(1) is not second
    assert torch.equal(store.get(1), second)
    for i in range(4):
        assert int(store.get(i).max()) == i + 1
        assert store.cached_bytes <= 2 << 20


def test_no_cache_still_gives_every_image(tmp_path: Path) -> None:
    want = save_image(tmp_path / "a.png")
    store = ImageStore([plain(tmp_path / "a.png")], cache_mb=0)
    assert torch.equal(store.get(0), torch.from_numpy(want))
    assert store.cached_bytes == 0


def test_threads_get_the_same_pixels(tmp_path: Path) -> None:
    want = [save_image(tmp_path / f"{i}.png", seed=i) for i in range(6)]
    store = ImageStore([plain(tmp_path / f"{i}.png") for i in range(6)], cache_mb=1)
    wrong: list[int] = []

    def read(order: list[int]) -> None:
        wrong.extend(i for i in order if not torch.equal(store.get(i), torch.from_numpy(want[i])))

    orders = [[(i * step + step) % 6 for i in range(60)] for step in (1, 5, 7, 11)]
    threads = [threading.Thread(target=read, args=(order,)) for order in orders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert store.cached_bytes == 6 * SIZE * SIZE * 4


def test_an_exif_orientation_leaves_the_stored_rows_and_columns(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate by 90 degrees to view
    Image.new("RGB", (8, 4)).save(tmp_path / "a.jpg", exif=exif)
    assert read_header(tmp_path / "a.jpg") == (8, 4, False)
    assert read_pixels(tmp_path / "a.jpg").shape == (4, 8, 3)


@pytest.mark.parametrize(
    ("mode", "channels"), [("1", 3), ("L", 3), ("P", 3), ("RGB", 3), ("LA", 4), ("RGBA", 4), ("I;16", 3)]
)
def test_every_mode_becomes_rgb_or_rgba(tmp_path: Path, mode: str, channels: int) -> None:
    Image.new(mode, (5, 3)).save(tmp_path / "a.png")
    assert read_pixels(tmp_path / "a.png").shape == (3, 5, channels)


def test_sixteen_bit_gray_is_scaled_not_clipped(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 2), 0x8000, dtype=np.uint16)).save(tmp_path / "a.png")
    assert read_pixels(tmp_path / "a.png").unique().tolist() == [0x80]


def test_a_dark_photo_of_sixteen_bits_stays_dark(tmp_path: Path) -> None:
    """Small numbers are a mask's 0 and 1, or 0 and 255, only in a mask."""
    Image.fromarray(np.array([[0, 100], [200, 255]], dtype=np.uint16)).save(tmp_path / "a.png")
    assert not bool(read_pixels(tmp_path / "a.png").any())


@pytest.mark.parametrize("mode", ["P", "L", "RGB"])
def test_a_transparent_color_is_alpha(tmp_path: Path, mode: str) -> None:
    """PNG's tRNS chunk, without a channel of its own."""
    image = Image.new(mode, (3, 2))
    if mode == "P":
        image.putpalette(bytes(range(30)))
    image.putpixel((1, 0), (9, 9, 9) if mode == "RGB" else 9)
    image.save(tmp_path / "a.png", transparency=(9, 9, 9) if mode == "RGB" else 9)
    assert read_header(tmp_path / "a.png") == (3, 2, True)
    assert read_pixels(tmp_path / "a.png")[..., 3].tolist() == [[255, 0, 255], [255, 255, 255]]


def test_a_truncated_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cut.png"
    save_image(path)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"cut\.png"):
        ImageStore([plain(path)], 1).get(0)


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a", b"\x89PNG\r\n\x1a\n", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"]
)
def test_what_is_no_image_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "odd.png").write_bytes(content)
    with pytest.raises(InputError, match=r"odd\.png"):
        read_header(tmp_path / "odd.png")


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_decompression_bomb_is_refused_by_its_header(tmp_path: Path) -> None:
    side = int(MAX_PIXELS**0.5) + 1
    path = tmp_path / "bomb.png"
    Image.new("1", (side, side)).save(path)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(InputError, match=r"bomb\.png"):
        read_header(path)


def test_a_changed_size_is_reported_with_both_sizes(tmp_path: Path) -> None:
    save_image(tmp_path / "a.png", np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(InputError, match="6x4 pixels, but the dataset declares 16x16"):
        ImageStore([plain(tmp_path / "a.png")], 1).get(0)


def test_a_mask_becomes_alpha_and_multiplies_the_images_own(tmp_path: Path) -> None:
    rgb = save_image(tmp_path / "a.png", mode="RGB")
    rgba = save_image(tmp_path / "b.png")
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[:, :8] = 255
    mask[0, 0] = 100
    Image.fromarray(mask).save(tmp_path / "m.png")
    store = ImageStore([plain(tmp_path / n, tmp_path / "m.png") for n in ("a.png", "b.png")], 1)
    assert np.array_equal(store.get(0)[..., :3], rgb)
    assert np.array_equal(store.get(0)[..., 3], mask)
    assert np.array_equal(store.get(1)[..., 3], np.minimum(mask, rgba[..., 3]))


def test_a_mask_of_zeros_and_ones_counts_as_black_and_white(tmp_path: Path) -> None:
    save_image(tmp_path / "a.png", mode="RGB")
    Image.fromarray(np.eye(SIZE, dtype=np.uint8)).save(tmp_path / "m.png")
    alpha = ImageStore([plain(tmp_path / "a.png", tmp_path / "m.png")], 1).get(0)[..., 3]
    assert np.array_equal(alpha, np.eye(SIZE) * 255)


def test_a_larger_mask_is_reduced_and_another_aspect_refused(tmp_path: Path) -> None:
    save_image(tmp_path / "a.png", mode="RGB")
    large = np.zeros((4 * SIZE, 4 * SIZE), np.uint8)
    large[:, : 2 * SIZE] = 255
    Image.fromarray(large).save(tmp_path / "m.png")
    alpha = ImageStore([plain(tmp_path / "a.png", tmp_path / "m.png")], 1).get(0)[..., 3]
    assert alpha[0].tolist() == [255] * 8 + [0] * 8
    Image.fromarray(large[:SIZE]).save(tmp_path / "m.png")
    with pytest.raises(InputError, match=r"m\.png is 64x16, but its image is 16x16"):
        ImageStore([plain(tmp_path / "a.png", tmp_path / "m.png")], 1).get(0)


def test_downscaling_is_the_area_mean(tmp_path: Path) -> None:
    pixels = save_image(tmp_path / "a.png", mode="RGB")
    got = ImageStore([plain(tmp_path / "a.png", size=4)], 1).get(0).numpy()
    want = pixels.reshape(4, 4, 4, 4, 3).mean(axis=(1, 3))
    assert np.abs(got - want).max() <= 0.5001


@pytest.mark.parametrize("white", [1, 255, 65535])
def test_a_mask_of_sixteen_bits_counts_whatever_its_white(tmp_path: Path, white: int) -> None:
    save_image(tmp_path / "m.png", (np.eye(4) * white).astype(np.uint16))
    gray = read_gray(tmp_path / "m.png", (4, 4))
    assert (gray > 0).tolist() == (np.eye(4) > 0).tolist()


def test_floating_point_images_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.eye(4, dtype=np.float32)).save(tmp_path / "f.tiff")
    with pytest.raises(InputError, match="floating-point"):
        read_pixels(tmp_path / "f.tiff")


def test_an_image_too_large_for_the_cache_drives_no_other_out(tmp_path: Path) -> None:
    sides = (256, 640)
    for side in sides:
        save_image(tmp_path / f"{side}.png", np.full((side, side, 4), 9, dtype=np.uint8))
    paths = [tmp_path / f"{side}.png" for side in sides]
    sources = [ImageSource(path, None, (side, side), None, side, side) for path, side in zip(paths, sides, strict=True)]
    store = ImageStore(sources, cache_mb=1)
    first = store.get(0)
    store.get(1)
    assert store.get(0) is first
    assert store.cached_bytes == 4 * 256**2
