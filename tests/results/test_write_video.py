"""Videos and frames: files hold the renders, and no file is overwritten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from gsopt.errors import InputError, UsageError
from gsopt.results.video import safe_name, save_stills, save_video


def pictures(count: int, height: int = 20, width: int = 30) -> list[torch.Tensor]:
    """Flat images of rising brightness."""
    return [torch.full((height, width, 3), 20 + 40 * i, dtype=torch.uint8) for i in range(count)]


def brightness(image: Image.Image) -> float:
    return float(np.asarray(image.convert("RGB"), dtype=np.float64).mean())


@pytest.mark.parametrize("fps", [1, 20])
@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_a_film_holds_every_frame_in_order_and_repeats(tmp_path: Path, suffix: str, fps: int) -> None:
    path = tmp_path / f"film{suffix}"
    save_video(path, pictures(5), fps=fps)
    with Image.open(path) as film:
        assert (film.size, film.n_frames, film.info["loop"]) == ((30, 20), 5, 0)
        for index in range(5):
            film.seek(index)
            film.load()
            assert brightness(film) == pytest.approx(20 + 40 * index, abs=4)
            assert film.info["duration"] == 1000 / fps


def test_an_mp4_holds_every_frame_even_of_odd_size(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    save_video(path, pictures(5, height=33, width=51), fps=12.5)
    with av.open(str(path)) as film:
        frames = [frame.to_image() for frame in film.decode(video=0)]
        assert float(film.streams.video[0].average_rate) == 12.5
    assert [image.size for image in frames] == [(50, 32)] * 5
    assert [brightness(image) for image in frames] == pytest.approx([20, 60, 100, 140, 180], abs=4)


def test_stills_are_lossless_and_named(tmp_path: Path) -> None:
    picture = torch.randint(0, 256, (7, 9, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    (path,) = save_stills(tmp_path / "new", [("0003_a", picture)])
    assert path.name == "0003_a.png"
    assert np.array_equal(np.asarray(Image.open(path)), picture.numpy())


def test_nothing_is_written_over_unless_asked(tmp_path: Path) -> None:
    film = tmp_path / "film.gif"
    film.write_bytes(b"precious")
    with pytest.raises(UsageError, match="--force"):
        save_video(film, pictures(1), fps=10)
    (tmp_path / "a.png").write_bytes(b"precious")
    with pytest.raises(UsageError, match="--force"):
        save_stills(tmp_path, [("a", pictures(1)[0])])
    assert film.read_bytes() == (tmp_path / "a.png").read_bytes() == b"precious"
    save_video(film, pictures(2), fps=10, overwrite=True)
    assert Image.open(film).n_frames == 2


def test_a_film_that_fails_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    with pytest.raises(InputError, match="one size, got 31x20 after 30x20"):
        save_video(path, [pictures(1)[0], pictures(1, width=31)[0]], fps=10)
    with pytest.raises(InputError, match="at least one frame"):
        save_video(path, [], fps=10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["film.avi", "film", "film.png"])
def test_an_unknown_format_is_a_usage_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"\.mp4, \.webp, \.gif"):
        save_video(tmp_path / name, pictures(1), fps=10)


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("test/r_0.png", "0007_r_0"),
        ("../../etc/passwd", "0007_passwd"),
        ("a\\..\\b<script>.jpg", "0007_b_script_"),
        ("ünï 1.png", "0007__n__1"),
        ("..", "0007___"),
        ("x" * 300 + ".png", "0007_" + "x" * 60),
    ],
)
def test_file_names_are_harmless(name: str, safe: str) -> None:
    assert safe_name(7, name) == safe
