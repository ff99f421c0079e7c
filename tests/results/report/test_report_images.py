"""Pictures of the report: how large they are, and the colors of errors."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsopt.results.report.embedded_images import animation_uri, data_uri, error_legend, error_map, read_image, shrunk


@pytest.mark.parametrize(
    ("level", "color"),
    [(0, (13, 16, 33)), (16, (43, 76, 155)), (32, (24, 169, 153)), (48, (242, 193, 78)), (64, (255, 246, 230))],
)
def test_a_quarter_of_the_range_is_the_end_of_the_scale(level: int, color: tuple[int, int, int]) -> None:
    """Errors of 16, 32, 48 and 64 of 255 are a sixteenth of 4, 8, 12 and 16 sixteenths, all but one part in 255."""
    truth, render = (Image.new("RGB", (1, 1), (value,) * 3) for value in (100, 100 + level))
    found = np.asarray(error_map(render, truth))[0, 0].astype(int)
    assert np.abs(found - np.array(color)).max() <= 3
    assert np.array_equal(np.asarray(error_map(truth, render)), np.asarray(error_map(render, truth)))


def test_an_error_is_the_mean_of_its_channels() -> None:
    black = Image.new("RGB", (1, 1))
    one, all_three = Image.new("RGB", (1, 1), (48, 0, 0)), Image.new("RGB", (1, 1), (16, 16, 16))
    assert error_map(one, black).getpixel((0, 0)) == error_map(all_three, black).getpixel((0, 0))
    assert error_map(one, one).getpixel((0, 0)) == (13, 16, 33)


def test_the_legend_names_the_ends_of_the_scale() -> None:
    legend = error_legend()
    assert "Error 0" in legend
    assert "0.25 and more" in legend
    assert "rgb(13 16 33) 0%" in legend
    assert "rgb(255 246 230) 100%" in legend


def test_a_picture_is_scaled_down_into_a_square_and_never_up() -> None:
    assert shrunk(Image.new("RGB", (100, 50)), 20).size == (20, 10)
    assert shrunk(Image.new("RGB", (50, 100)), 20).size == (10, 20)
    assert shrunk(Image.new("RGB", (15, 20)), 20).size == (15, 20)


def test_a_picture_of_just_the_most_pixels_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (6, 4), "red").save(path)
    found = read_image(path, 100, 24)
    assert found is not None
    assert found.size == (6, 4)
    assert read_image(path, 100, 23) is None
    assert read_image(tmp_path / "absent.png", 100, 24) is None
    Image.new("RGB", (6, 4), "red").save(tmp_path / "b.png", format="JPEG")
    assert read_image(tmp_path / "b.png", 100, 24) is None


def test_a_data_uri_holds_the_picture() -> None:
    picture = Image.new("RGB", (20, 10), (200, 40, 90))
    kind, data = data_uri(picture).split(",")
    assert kind == "data:image/webp;base64"
    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(data)), formats=("WEBP",)).convert("RGB")).astype(int)
    assert shown.shape == (10, 20, 3)
    assert np.abs(shown - np.array([200, 40, 90])).max() <= 6


def test_an_animation_repeats_without_end_at_its_pace() -> None:
    frames = [Image.new("RGB", (8, 8), color) for color in ("red", "green", "blue")]
    film = Image.open(io.BytesIO(base64.b64decode(animation_uri(frames, 12.5).split(",")[1])), formats=("WEBP",))
    assert film.n_frames == 3
    assert film.info["loop"] == 0
    film.load()
    assert film.info["duration"] == 80
