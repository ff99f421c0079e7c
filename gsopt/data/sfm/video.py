"""Selection of a video's frames: apart from each other, and the sharpest of their neighborhood.

Two passes: the first measures every frame in small, the second writes the chosen ones. Motion is the shift of a grid
of tiles (phase correlation, Kuglin and Hines 1975) against an anchor frame, which is replaced once the image has
moved visibly: a slow path adds up, a trembling hand does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float32
from PIL import Image

from gsopt._optional import require
from gsopt.data.image_files import MAX_PIXELS, write_image
from gsopt.data.sfm.photos import sharpness
from gsopt.errors import InputError

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mts", ".3gp", ".gif")
CONTAINERS = {"format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,mpegvideo,gif"}
"""FFmpeg's names for SUFFIXES: its playlists (concat, hls) would open other files."""
MEASURED_SIDE = 256
"""Longer side at which frames are measured, px."""
TILES_PER_SIDE = 4
MIN_MOTION, MAX_MOTION = 0.02, 0.08
"""Between two kept frames, share of the longer side: below, near-duplicates. Two frames with nothing in common count as
this far apart."""
MIN_STEP = 0.008
"""A shorter way from the anchor frame is trembling, share of the longer side (2 px at MEASURED_SIDE)."""
CENTRAL_SHARE = 0.6
"""Middle part of a stretch of motion in which its sharpest frame is looked for: keeps neighbors apart."""
MIN_PEAK = 6.0
"""A correlation peak below this, over the root of a tile's pixels, means that two frames have nothing in common: a cut,
or a jump. Noise peaks at 4.5 to 5, images of one thing that moved a little at 6 and far above."""
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class FrameMeasurement:
    """One frame of the first pass."""

    index: int
    seconds: float
    sharpness: float
    motion: float
    """Way covered since the start of the video, share of the longer side; never falls."""


@dataclass(frozen=True)
class FrameSelection:
    """The frames selected from a video."""

    paths: list[Path]
    decoded: int
    seconds: float
    motion: float
    """Length of the whole path, in longer sides of the image."""


def is_video(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES


def extract_frames(video: Path, folder: Path, most: int) -> FrameSelection:
    """Write at most `most` well-chosen frames to `folder` as NAME_00001.jpg, numbered as in the video.

    Raises InputError for a file that is empty, broken or no video, MissingDependency without PyAV.
    """
    av = require("av", "sfm", "Reading a video")
    if not video.is_file() or video.stat().st_size == 0:
        got = "0 bytes" if video.is_file() else "no such file"
        raise InputError(f"The video {video} cannot be read: {got}. Copy it again from the camera.")
    measured = measure(_small_frames(av, video))
    if not measured:
        raise InputError(f"The video {video} holds no picture that can be decoded. Copy it again from the camera.")
    wanted = set(choose(measured, most))
    folder.mkdir(parents=True)
    paths = [_write(image, folder, index) for index, image in _upright(av, video) if index in wanted]
    return FrameSelection(paths, len(measured), measured[-1].seconds, measured[-1].motion)


def measure(frames: Iterator[tuple[int, float, Image.Image]]) -> list[FrameMeasurement]:
    """Sharpness and motion of (index, seconds, gray image)."""
    measured: list[FrameMeasurement] = []
    anchor: Float32[np.ndarray, "h w"] | None = None
    way = 0.0
    for index, seconds, gray in frames:
        image = np.asarray(gray, dtype=np.float32)
        if anchor is None or anchor.shape != image.shape:
            anchor = image
        step = motion_between(anchor, image)
        if step > MIN_STEP:
            way, anchor = way + step, image
        measured.append(FrameMeasurement(index, seconds, sharpness(gray), way))
    return measured


def choose(measured: list[FrameMeasurement], most: int) -> list[int]:
    """Indices of the frames to keep, in order: one for every equal stretch of the way."""
    stretch = max(measured[-1].motion / most, MIN_MOTION)
    stretches: dict[int, list[FrameMeasurement]] = {}
    for frame in measured:
        stretches.setdefault(int(frame.motion / stretch), []).append(frame)
    return [_sharpest(frames, stretch).index for _, frames in sorted(stretches.items())][:most]


def motion_between(before: Float32[np.ndarray, "h w"], after: Float32[np.ndarray, "h w"]) -> float:
    """Median shift of the tiles, share of the longer side; MAX_MOTION when the frames have nothing in common."""
    if np.array_equal(before, after):
        return 0.0
    height, width = (extent // TILES_PER_SIDE for extent in before.shape)
    window = np.hanning(height)[:, None] * np.hanning(width)[None]
    corners = [(row * height, column * width) for row in range(TILES_PER_SIDE) for column in range(TILES_PER_SIDE)]
    tiles = [np.s_[top : top + height, left : left + width] for top, left in corners]
    shifts, peaks = zip(*(_correlate(before[tile], after[tile], window) for tile in tiles), strict=True)
    if float(np.median(peaks)) < MIN_PEAK / np.sqrt(height * width):
        return MAX_MOTION
    return float(np.median(np.linalg.norm(np.array(shifts), axis=1))) / max(before.shape)


def _correlate(before: Any, after: Any, window: Any) -> tuple[tuple[float, float], float]:
    """Shift by phase correlation and how clear its peak is (1: a pure shift)."""
    spectrum = np.fft.rfft2((after - after.mean()) * window) * np.conj(np.fft.rfft2((before - before.mean()) * window))
    surface = np.fft.irfft2(spectrum / np.maximum(np.abs(spectrum), 1e-6), s=before.shape)
    peak = np.unravel_index(int(surface.argmax()), surface.shape)
    row, column = (
        int(p) if p <= extent // 2 else int(p) - extent for p, extent in zip(peak, before.shape, strict=True)
    )
    return (float(row), float(column)), float(surface.max())


def _sharpest(frames: list[FrameMeasurement], stretch: float) -> FrameMeasurement:
    middle = (int(frames[0].motion / stretch) + 0.5) * stretch
    central = [frame for frame in frames if abs(frame.motion - middle) <= CENTRAL_SHARE / 2 * stretch]
    return max(central or frames, key=lambda frame: frame.sharpness)


def _small_frames(av: ModuleType, video: Path) -> Iterator[tuple[int, float, Image.Image]]:
    for index, frame in _decoded(av, video):
        scale = min(1.0, MEASURED_SIDE / max(frame.width, frame.height))
        size = (
            max(TILES_PER_SIDE * 4, round(frame.width * scale)),
            max(TILES_PER_SIDE * 4, round(frame.height * scale)),
        )
        gray = frame.reformat(width=size[0], height=size[1], format="gray")
        yield index, float(frame.time or 0.0), Image.fromarray(gray.to_ndarray())


def _upright(av: ModuleType, video: Path) -> Iterator[tuple[int, Image.Image]]:
    for index, frame in _decoded(av, video):
        turn = round(getattr(frame, "rotation", 0) / 90) % 4
        image = frame.to_image()
        yield index, image.rotate(90 * turn, expand=True) if turn else image


def _decoded(av: ModuleType, video: Path) -> Iterator[tuple[int, Any]]:
    """Every frame that can be decoded; a file that breaks off is read up to there."""
    index = 0
    try:
        with av.open(str(video), container_options=CONTAINERS, metadata_errors="replace") as container:
            if not container.streams.video:
                raise InputError(f"{video} holds no video track, only sound or data. Give another file.")
            for frame in container.decode(video=0):
                if frame.width * frame.height > MAX_PIXELS:
                    raise InputError(f"{video} is {frame.width}x{frame.height} px a frame. Scale it down first.")
                yield index, frame
                index += 1
    except av.error.FFmpegError as error:
        if index == 0:
            raise InputError(
                f"The video {video} cannot be decoded: {error.strerror or error}. Copy it again, or convert it to MP4."
            ) from error


def _write(image: Image.Image, folder: Path, index: int) -> Path:
    path = folder / f"frame_{index + 1:05d}.jpg"
    write_image(image.convert("RGB"), path, quality=_JPEG_QUALITY, subsampling=0)
    return path
