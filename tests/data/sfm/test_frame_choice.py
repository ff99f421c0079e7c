"""Frames of a video: shifts between them to the pixel, cuts, which are kept, and what is written."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image, JpegImagePlugin

from gsopt.data.sfm import video
from gsopt.data.sfm.video import FrameMeasurement, choose, measure, motion_between

NOISE = np.random.default_rng(0).uniform(0, 255, (16, 16)).astype(np.float32)


@pytest.mark.parametrize("shift", [(0, 0), (6, -7), (-5, 3), (7, 7), (-1, 0)])
@pytest.mark.parametrize("contrast", [1.0, 1e-4])
def test_a_tile_that_is_shifted_around_itself_gives_its_shift_and_a_peak_of_one(
    shift: tuple[int, int], contrast: float
) -> None:
    """Up to half of its side in each direction, however dim it is."""
    tile = contrast * NOISE.astype(np.float64)
    found, peak = video._correlate(tile, np.roll(tile, shift, (0, 1)), np.ones((16, 16)))
    assert found == shift
    assert peak == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize(("peak", "cut"), [(0.374, True), (0.375, False), (0.4, False)])
def test_a_cut_is_a_peak_below_six_over_the_root_of_a_tiles_pixels(
    peak: float, cut: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The median of 16 tiles of 16 x 16 px decides. It counts as a way of 8 % of the longer side."""
    tiles = iter([((3.0, 4.0), peak)] * 9 + [((3.0, 4.0), 1.0)] * 7)
    monkeypatch.setattr(video, "_correlate", lambda *_: next(tiles))
    frames = np.zeros((64, 64), np.float32), np.ones((64, 64), np.float32)
    assert motion_between(*frames) == pytest.approx(0.08 if cut else 5 / 64)


def test_two_pictures_of_other_things_are_a_cut_apart() -> None:
    generator = np.random.default_rng(1)
    one, other = (generator.uniform(0, 255, (96, 128)).astype(np.float32) for _ in range(2))
    assert motion_between(one, other) == pytest.approx(0.08)
    assert motion_between(one, one.copy()) == 0


@pytest.mark.parametrize(("step", "way"), [(0.008, [0, 0, 0, 0]), (0.0081, [0, 0.0081, 0.0162, 0.0243])])
def test_a_way_of_more_than_eight_thousandths_counts_and_the_next_is_measured_from_there(
    step: float, way: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The anchor of a trembling picture stays the first frame."""
    anchors: list[int] = []

    def motion(anchor: np.ndarray, image: np.ndarray) -> float:
        anchors.append(int(anchor[0, 0]))
        return 0.0 if anchor is image else step

    monkeypatch.setattr(video, "motion_between", motion)
    frames = [(i, i / 10, Image.new("L", (16, 16), i)) for i in range(4)]
    measured = measure(iter(frames))
    assert [frame.motion for frame in measured] == pytest.approx(way)
    assert anchors == ([0, 0, 0, 0] if way[1] == 0 else [0, 0, 1, 2])
    assert [(frame.index, frame.seconds) for frame in measured] == [(0, 0), (1, 0.1), (2, 0.2), (3, 0.3)]


def test_a_frame_of_another_size_begins_a_new_way() -> None:
    sizes = [(64, 64), (64, 32), (64, 32)]
    measured = measure((index, 0.0, Image.new("L", size)) for index, size in enumerate(sizes))
    assert [frame.motion for frame in measured] == [0, 0, 0]


def moved(*ways: float, sharpness: float = 1.0) -> list[FrameMeasurement]:
    return [FrameMeasurement(index, 0.0, sharpness, way) for index, way in enumerate(ways)]


def test_kept_frames_are_spread_over_the_whole_way_and_lie_amid_their_stretches() -> None:
    """Two stretches of 0.45: of the first, 0.3 lies within three tenths of it around its middle, and 0 does not."""
    assert choose(moved(0, 0.3, 0.9), 2) == [1, 2]
    assert choose(moved(0, 0.3, 0.9), 3) == [0, 1, 2]


def test_frames_that_are_less_than_a_fiftieth_apart_are_one() -> None:
    assert choose(moved(0, 0.01, 0.019), 9) == [1]
    assert choose(moved(0, 0.01, 0.021), 9) == [1, 2]


def test_frames_are_numbered_as_they_are_decoded() -> None:
    frame = SimpleNamespace(width=4, height=4)
    container = SimpleNamespace(streams=SimpleNamespace(video=[1]), decode=lambda video: iter([frame] * 3))
    av: Any = SimpleNamespace(open=lambda *_, **__: nullcontext(container), error=SimpleNamespace(FFmpegError=OSError))
    assert [index for index, _ in video._decoded(av, Path("a"))] == [0, 1, 2]


def test_what_is_written_are_the_chosen_frames_and_what_is_told_is_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder may lie below one that does not exist yet."""
    measured = [FrameMeasurement(i, i / 10, 1.0, i / 20) for i in range(5)]
    pictures = [Image.new("RGB", (8, 8), (40 * i, 0, 0)) for i in range(5)]
    monkeypatch.setattr(video, "require", lambda *_: None)
    monkeypatch.setattr(video, "_small_frames", lambda av, path: iter(()))
    monkeypatch.setattr(video, "measure", lambda frames: measured)
    monkeypatch.setattr(video, "choose", lambda given, most: [1, most])
    monkeypatch.setattr(video, "_upright", lambda av, path: enumerate(pictures))
    (tmp_path / "film.mp4").write_bytes(b"film")
    found = video.extract_frames(tmp_path / "film.mp4", tmp_path / "below" / "frames", 3)
    assert (found.decoded, found.seconds, found.motion) == (5, 0.4, 0.2)
    assert [path.name for path in found.paths] == ["frame_00002.jpg", "frame_00004.jpg"]
    for path, index in zip(found.paths, (1, 3), strict=True):
        with Image.open(path) as image:
            red, green, blue = np.asarray(image).reshape(-1, 3).mean(0)
        assert (red, green, blue) == pytest.approx((40 * index, 0, 0), abs=3)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
def test_a_frame_is_a_jpeg_with_the_colors_of_every_pixel(mode: str, tmp_path: Path) -> None:
    path = video._write(Image.new(mode, (8, 8)), tmp_path, 0)
    with Image.open(path) as image:
        assert (image.format, image.mode, image.size) == ("JPEG", "RGB", (8, 8))
        assert JpegImagePlugin.get_sampling(image) == 0
