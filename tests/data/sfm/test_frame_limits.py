"""Frames of a video as PyAV gives them: their size when they are measured, their turn, their names, their limit."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import video
from gsopt.errors import InputError


class Frame:
    """A frame of PyAV."""

    def __init__(self, width: int, height: int, rotation: int = 0) -> None:
        self.width, self.height, self.rotation, self.time = width, height, rotation, None
        self.asked: dict[str, Any] = {}

    def reformat(self, **asked: Any) -> Any:
        self.asked = asked
        return SimpleNamespace(to_ndarray=lambda: np.zeros((asked["height"], asked["width"]), np.uint8))

    def to_image(self) -> Image.Image:
        return Image.fromarray(np.arange(6, dtype=np.uint8).reshape(2, 3))


@pytest.mark.parametrize(
    ("size", "small"),
    [
        ((512, 256), (256, 128)),
        ((100, 50), (100, 50)),
        ((2560, 100), (256, 16)),
        ((3, 900), (16, 256)),
        ((8, 8), (16, 16)),
    ],
)
def test_frames_are_measured_at_256_pixels_and_16_at_least(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], small: tuple[int, int]
) -> None:
    frame = Frame(*size)
    monkeypatch.setattr(video, "_decoded", lambda av, path: iter([(4, frame)]))
    ((index, seconds, gray),) = video._small_frames(None, Path())  # type: ignore[arg-type]
    assert (index, seconds, gray.size) == (4, 0.0, small)


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (-90, 3), (180, 2), (89, 1), (360, 0)])
def test_frames_are_turned_upright(monkeypatch: pytest.MonkeyPatch, rotation: int, turns: int) -> None:
    monkeypatch.setattr(video, "_decoded", lambda av, path: iter([(0, Frame(3, 2, rotation))]))
    ((_, image),) = video._upright(None, Path())  # type: ignore[arg-type]
    assert np.array_equal(np.asarray(image), np.rot90(np.arange(6).reshape(2, 3), turns))


def test_a_frame_is_named_by_its_number_from_one_on(tmp_path: Path) -> None:
    assert video._write(Image.new("RGB", (8, 8)), tmp_path, 0).name == "frame_00001.jpg"
    assert video._write(Image.new("RGB", (8, 8)), tmp_path, 41).name == "frame_00042.jpg"


@pytest.mark.parametrize(("size", "fine"), [((10, 10), True), ((101, 1), False)])
def test_frames_that_no_photo_may_have_are_refused(
    monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], fine: bool
) -> None:
    monkeypatch.setattr(video, "MAX_PIXELS", 100)
    container = SimpleNamespace(streams=SimpleNamespace(video=[1]), decode=lambda video: iter([Frame(*size)]))
    error = SimpleNamespace(FFmpegError=OSError)
    av: Any = SimpleNamespace(open=lambda *_, **__: nullcontext(container), error=error)
    if fine:
        assert [index for index, _ in video._decoded(av, Path("a"))] == [0]
    else:
        with pytest.raises(InputError, match="101x1 px a frame"):
            list(video._decoded(av, Path("a")))
