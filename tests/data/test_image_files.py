"""Image files of strangers: no decoder that starts a program, and nothing decoded that no photo comes to."""

from __future__ import annotations

import contextlib
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from dataset_builders import nerf_synthetic
from PIL import Image

from gsopt.data import image_files
from gsopt.data.image_files import write_image
from gsopt.data.images import read_gray, read_header, read_pixels
from gsopt.data.scene import load_scene
from gsopt.data.sfm.photos import read_photos
from gsopt.errors import InputError
from gsopt.finetune.on_views.images import read_upright
from gsopt.llm_prompts.expert_images import read_views
from gsopt.training.guided.references import read_references

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 200 200\n%%EndComments\n(%pipe%touch owned) (w) file\n%%EOF\n"


def refused_photo(path: Path) -> None:
    photos, refused = read_photos([path], path.parent / "work")
    assert photos == []
    raise InputError(f"{refused[0].name}: {refused[0].reason}.")


READERS: dict[str, Callable[[Path], object]] = {
    "header": read_header,
    "pixels": read_pixels,
    "mask": lambda path: read_gray(path, (200, 200)),
    "photo": refused_photo,
    "training image": read_upright,
    "expert's photo": lambda path: read_views([path]),
    "reference image": lambda path: read_references((str(path),), 64),
}


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that exists once Ghostscript was started."""
    mark = tmp_path / "started"
    (tmp_path / "bin").mkdir()
    for name in ("gs", "gswin32c", "gswin64c"):
        program = tmp_path / "bin" / name
        program.write_text(f"#!/bin/sh\n: > '{mark}'\n")
        program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"), prepend=":")
    monkeypatch.setattr("PIL.EpsImagePlugin.gs_binary", None)  # it remembers what it found
    return mark


def test_pillow_alone_starts_ghostscript(tmp_path: Path, started: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(EPS)
    with contextlib.suppress(OSError):
        Image.open(tmp_path / "a.jpg").load()
    assert started.exists()


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
@pytest.mark.parametrize("reader", READERS)
def test_postscript_in_an_image_is_never_run(tmp_path: Path, started: Path, reader: str, name: str) -> None:
    (tmp_path / name).write_bytes(EPS)
    with pytest.raises(InputError, match=name.replace(".", r"\.")) as caught:
        READERS[reader](tmp_path / name)
    assert not started.exists()
    assert str(caught.value).count(". ") >= 1  # what and got, then what to do


def test_a_photo_that_is_none_names_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(EPS)
    _, (refused,) = read_photos([tmp_path / "a.jpg"], tmp_path / "work")
    assert "is no image, whatever its name says; read are PNG, JPEG, WEBP, TIFF, BMP" in refused.reason
    assert "Copy it again" in refused.reason


def one_bit_png(path: Path, side: int) -> Path:
    """An empty image of one bit a pixel: the smallest PNG of its size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(bytes((1 + (side + 7) // 8) * side), 9)
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    return path


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("reader", [name for name in READERS if name != "mask"])
def test_a_bomb_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str) -> None:
    path = one_bit_png(tmp_path / "a.png", 11_500)
    assert path.stat().st_size < 20_000
    monkeypatch.setattr(Image.Image, "load", lambda self: pytest.fail("decoded"))
    with pytest.raises(InputError, match=r"a\.png.*11500x11500 pixels"):
        READERS[reader](path)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_an_image_at_a_limit_is_read_and_one_beyond_is_not(tmp_path: Path, channels: int) -> None:
    file = tmp_path / "a.png"

    def refused(pixels: int, size: int, **limits: int) -> str:
        file.write_bytes(bytes(1))
        os.truncate(file, size)
        image = SimpleNamespace(width=pixels, height=1)
        return image_files.bomb(image, file, channels, **limits)  # type: ignore[arg-type]

    assert refused(100, 10, max_pixels=100) == ""
    assert "101x1 pixels, more than the 100" in refused(101, 10, max_pixels=100)
    for size in (1, image_files.MAX_PIXELS // image_files.MAX_EXPANSION + 120):
        most = max(image_files.MAX_PIXELS, image_files.MAX_EXPANSION * size) // channels
        assert refused(most, size, max_pixels=1 << 40) == ""
        assert f"in a file of {size:,} bytes" in refused(most + 1, size, max_pixels=1 << 40)


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_dataset_with_a_bomb_is_refused_when_it_is_loaded(tmp_path: Path) -> None:
    one_bit_png(nerf_synthetic(tmp_path) / "train" / "r_3.png", 11_500)
    with pytest.raises(InputError, match=r"r_3\.png declares 11500x11500 pixels in a file of"):
        load_scene(tmp_path)


def test_an_empty_mask_of_a_large_photo_is_no_bomb(tmp_path: Path) -> None:
    path = one_bit_png(tmp_path / "a.png", 8192)
    assert path.stat().st_size < 10_000
    assert read_gray(path, (64, 64)).shape == (64, 64)


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files")
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_an_image_that_the_disk_takes_in_part_is_an_error(tmp_path: Path, suffix: str) -> None:
    """Pillow's own writer ends well there, and leaves half of a JPEG."""
    import resource

    pixels = np.random.default_rng(0).integers(0, 256, (60, 60, 3), dtype=np.uint8)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="large"):
            write_image(Image.fromarray(pixels), tmp_path / f"a{suffix}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    write_image(Image.fromarray(pixels), tmp_path / f"a{suffix}")
    with Image.open(tmp_path / f"a{suffix}") as found:
        assert (found.format, found.size) == ({".jpg": "JPEG", ".png": "PNG"}[suffix], (60, 60))
