"""Renders to files: PNG frames in a folder, or a video as MP4, WebP or GIF."""

from __future__ import annotations

import io
import itertools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from gsopt import check
from gsopt._optional import require
from gsopt.errors import InputError, UsageError
from gsopt.formats.files import replacing

VIDEO_SUFFIXES = (".mp4", ".webp", ".gif")
WEBP_QUALITY = 85
FAST = 2
"""Compression of PNG: a tenth larger than the default of 6, in two fifths of its time."""
MAX_SIDE = {".webp": 16383, ".gif": 65535, ".mp4": 8192}
"""Longest side that the format (WebP, GIF) or common decoders (H.264) support, px."""


def save_video(output: Path, renders: Iterable[UInt8[Tensor, "H W 3"]], fps: float, *, overwrite: bool = False) -> None:
    """Writes a video in the format that the suffix of `output` names; whole file or nothing.

    Raises UsageError when the file exists and `overwrite` is not set, InputError for images of different sizes,
    MissingDependency for MP4 without the package `av`.
    """
    kind = output.suffix.lower()
    check.one_of("suffix of --out", kind, VIDEO_SUFFIXES)
    check.within("--fps", fps, 0.1, 240, "24 is usual.")
    if output.exists() and not overwrite:
        raise UsageError(f"{output} exists already. Add --force to replace it, or name another file.")
    if kind == ".mp4":
        require("av", "video", "Writing an MP4 video")
    images = _same_size(renders, MAX_SIDE[kind])
    first = next(images)
    with replacing(output) as file:
        write_video(file, itertools.chain([first], images), kind, fps)


def write_video(file: BinaryIO, images: Iterator[Image.Image], kind: str, fps: float) -> None:
    """Encode images of one size into an open, seekable file."""
    if kind == ".mp4":
        _write_mp4(file, images, fps)
        return
    first = next(images)
    # GIF counts in hundredths of a second, and players slow down frames shorter than two of them.
    duration = round(1000 / fps) if kind == ".webp" else max(20, 10 * round(100 / fps))
    options: dict[str, Any] = {"quality": WEBP_QUALITY, "method": 4} if kind == ".webp" else {"optimize": False}
    options |= {"append_images": images, "duration": duration, "loop": 0}
    buffer = io.BytesIO()  # Pillow's own writer leaves a gap where the disk takes less than it is given
    first.save(buffer, format=kind[1:].upper(), save_all=True, **options)
    file.write(buffer.getvalue())


def _write_mp4(file: BinaryIO, images: Iterator[Image.Image], fps: float) -> None:
    av = require("av", "video", "Writing an MP4 video")
    with av.open(file, "w", format="mp4") as container:
        stream = None
        for image in images:
            # 4:2:0 chroma has one sample for two rows and columns: an odd last one is cut off.
            image = image.crop((0, 0, max(2, image.width // 2 * 2), max(2, image.height // 2 * 2)))
            if stream is None:
                rate = Fraction(fps).limit_denominator(1000)
                stream = container.add_stream("libx264", rate=rate, options={"crf": "18"})
                stream.width, stream.height, stream.pix_fmt = image.width, image.height, "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        if stream is not None:
            container.mux(stream.encode())


def save_stills(
    folder: Path, renders: Iterable[tuple[str, UInt8[Tensor, "H W 3"]]], *, overwrite: bool = False
) -> list[Path]:
    """Writes each image as FOLDER/NAME.png and returns the paths. The names must be safe (see `safe_name`).

    Raises UsageError before writing over a file, unless `overwrite` is set; InputError when the disk refuses.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder {folder}: {error.strerror}. Choose another one.") from error
    written: list[Path] = []
    for name, render in renders:
        path = folder / f"{name}.png"
        if path.exists() and not overwrite:
            raise UsageError(f"{path} exists already. Add --force to replace it, or name another folder.")
        with replacing(path) as file:
            as_image(render).save(file, format="PNG", compress_level=FAST)
        written.append(path)
    return written


def safe_name(index: int, name: str) -> str:
    """A file name that sorts by index, keeps the harmless characters of a view's name and never leaves its folder."""
    stem = Path(name.replace("\\", "/")).stem
    harmless = "".join(letter if letter.isascii() and (letter.isalnum() or letter in "-_") else "_" for letter in stem)
    return f"{index:04d}_{harmless[:60]}"


def as_image(render: UInt8[Tensor, "H W 3"]) -> Image.Image:
    return Image.fromarray(render.contiguous().numpy())


def _same_size(renders: Iterable[Tensor], largest: int) -> Iterator[Image.Image]:
    """Images one by one; InputError at the first of another size, or when there is none."""
    size: tuple[int, int] | None = None
    for render in renders:
        image = as_image(render)
        size = size or image.size
        if image.size != size:
            got = f"{image.width}x{image.height} after {size[0]}x{size[1]}"
            raise InputError(f"All frames of a video must have one size, got {got}. Write PNG frames instead.")
        if max(size) > largest:
            raise InputError(
                f"This format holds at most {largest} px a side, got {max(size)}. Write PNG frames instead."
            )
        yield image
    if size is None:
        raise InputError("A video needs at least one frame, got none. Give a path with cameras on it.")
