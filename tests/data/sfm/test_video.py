"""Frames of a video: apart from each other, the sharp ones, upright; and what is said of files that are no video."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import textured_room as room
from PIL import Image, ImageFilter

from gsopt.data.sfm.video import (
    MAX_MOTION,
    MIN_MOTION,
    SUFFIXES,
    FrameMeasurement,
    choose,
    extract_frames,
    motion_between,
)
from gsopt.errors import InputError

av = pytest.importorskip("av", reason="the extra sfm is not installed")


def film(path: Path, pictures: list[Image.Image], **metadata: str) -> Path:
    with av.open(str(path), "w") as container:
        container.metadata.update(metadata)
        stream = container.add_stream("libx264", rate=Fraction(10), options={"crf": "12"})
        stream.width, stream.height = pictures[0].size
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode())
    return path


def frame_numbers(paths: list[Path]) -> list[int]:
    return [int(path.stem.removeprefix("frame_")) - 1 for path in paths]


@pytest.fixture(scope="module")
def pan() -> list[Image.Image]:
    """A window of 320 x 240 that slides by 4 px a frame, 0.0125 of its longer side."""
    texture = room.textures(3)[0].resize((700, 480))
    return [texture.crop((4 * i, 80, 4 * i + 320, 320)) for i in range(60)]


def test_a_title_that_is_no_utf8_does_not_matter(pan: list[Image.Image], tmp_path: Path) -> None:
    plain = film(tmp_path / "plain.mkv", pan[:8], title="Vacances d'ete")
    (tmp_path / "titled.mkv").write_bytes(plain.read_bytes().replace(b"d'ete", b"d'\xe9t\xe9"))
    with pytest.raises(UnicodeDecodeError), av.open(str(tmp_path / "titled.mkv")):
        pass
    chosen = extract_frames(tmp_path / "titled.mkv", tmp_path / "frames", 150)
    same = extract_frames(plain, tmp_path / "again", 150)
    assert [path.name for path in chosen.paths] == [path.name for path in same.paths]
    assert chosen.decoded == 8


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix not in (".mpg", ".mpeg", ".webm", ".gif")])
def test_h264_is_read_from_every_container(pan: list[Image.Image], tmp_path: Path, suffix: str) -> None:
    assert extract_frames(film(tmp_path / f"a{suffix}", pan[:3]), tmp_path / "frames", 9).decoded == 3


@pytest.mark.parametrize(("suffix", "codec"), [(".mpg", "mpeg2video"), (".webm", "libvpx"), (".gif", "gif")])
def test_other_codecs_are_read_too(pan: list[Image.Image], tmp_path: Path, suffix: str, codec: str) -> None:
    with av.open(str(tmp_path / f"a{suffix}"), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "rgb8" if codec == "gif" else "yuv420p"
        for picture in pan[:3]:
            container.mux(stream.encode(av.VideoFrame.from_image(picture).reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())
    assert extract_frames(tmp_path / f"a{suffix}", tmp_path / "frames", 9).decoded == 3


def test_a_playlist_is_no_video_whatever_its_name_says(pan: list[Image.Image], tmp_path: Path) -> None:
    """FFmpeg would open the files that it names."""
    film(tmp_path / "private.mkv", pan[:3])
    (tmp_path / "a.mp4").write_text("ffconcat version 1.0\nfile private.mkv\n")
    with pytest.raises(InputError, match=r"a\.mp4 cannot be decoded.*Copy it again"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 9)


def test_frames_are_apart_by_the_motion_asked_for(pan: list[Image.Image], tmp_path: Path) -> None:
    chosen = extract_frames(film(tmp_path / "pan.mp4", pan), tmp_path / "frames", 150)
    assert chosen.decoded == 60
    steps = np.diff(frame_numbers(chosen.paths)) * 4 / 320
    assert steps.min() > 0.4 * MIN_MOTION
    assert steps.max() < MAX_MOTION
    assert 20 <= len(chosen.paths) < 45


def test_standing_still_gives_one_frame_however_long(pan: list[Image.Image], tmp_path: Path) -> None:
    chosen = extract_frames(film(tmp_path / "still.mp4", [pan[0]] * 30), tmp_path / "frames", 150)
    assert len(chosen.paths) == 1


def test_blurred_frames_are_passed_over(pan: list[Image.Image], tmp_path: Path) -> None:
    shaken = [p.filter(ImageFilter.GaussianBlur(4)) if i % 2 else p for i, p in enumerate(pan)]
    chosen = extract_frames(film(tmp_path / "shaken.mp4", shaken), tmp_path / "frames", 10)
    assert len(chosen.paths) == 10
    assert [number % 2 for number in frame_numbers(chosen.paths)] == [0] * 10


def test_never_more_than_asked_for_and_spread_over_the_way() -> None:
    measured = [FrameMeasurement(i, i / 10, 1.0, 0.01 * i) for i in range(1000)]
    chosen = choose(measured, 20)
    assert len(chosen) == 20
    assert np.ptp(np.diff(chosen)) <= 40
    assert chosen[0] < 50 < 950 < chosen[-1]


def test_motion_is_the_shift_of_the_picture() -> None:
    texture = np.asarray(room.textures(3)[1].convert("L"), dtype=np.float32)
    before, after = texture[100:292, 100:356], texture[106:298, 108:364]
    assert motion_between(before, after) == pytest.approx(10 / 256, abs=1 / 256)
    assert motion_between(before, before) == 0
    other = np.asarray(room.textures(8)[2].convert("L"), dtype=np.float32)[100:292, 100:356]
    assert motion_between(before, other) == MAX_MOTION, "a cut is no small step"


def test_a_video_that_breaks_off_is_read_up_to_there(pan: list[Image.Image], tmp_path: Path) -> None:
    whole = film(tmp_path / "whole.mkv", pan).read_bytes()
    (tmp_path / "cut.mkv").write_bytes(whole[: len(whole) * 2 // 3])
    chosen = extract_frames(tmp_path / "cut.mkv", tmp_path / "frames", 150)
    assert 10 < chosen.decoded < 60
    assert chosen.paths


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "cannot be read: 0 bytes. Copy it again"),
        (b"not a film" * 99, "cannot be decoded: .*Copy it again, or convert"),
    ],
)
def test_a_file_that_is_no_video_is_an_input_error(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(InputError, match=words):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 10)
    assert not (tmp_path / "frames").exists()


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "song.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), dtype=np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with pytest.raises(InputError, match="holds no video track"):
        extract_frames(tmp_path / "song.mp4", tmp_path / "frames", 10)
