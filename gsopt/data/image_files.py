"""Image files: the formats that are read, and the bounds that a header must keep before anything is decoded."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from PIL import Image

IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
"""Every `Image.open` is limited to these: Pillow's decoder for EPS runs Ghostscript, others see few files."""
MAX_PIXELS = 1 << 27
"""134 megapixels: above any camera, below a decompression bomb."""
MAX_EXPANSION = 1000
"""Decoded bytes per byte of the file; an empty JPEG has 260. Only images of more than MAX_PIXELS bytes are compared,
because an empty mask may shrink without bound."""


def write_image(image: Image.Image, path: Path, **options: Any) -> None:
    """Writes a .png or .jpg, encoded in memory: Pillow's own writer leaves a gap where the disk takes less than it is
    given."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG" if path.suffix == ".png" else "JPEG", **options)
    path.write_bytes(buffer.getvalue())


def bomb(image: Image.Image, path: Path, channels: int = 4, max_pixels: int = MAX_PIXELS) -> str:
    """The reason not to decode an image to `channels` bytes a pixel; empty for one that may be decoded."""
    pixels, size = image.width * image.height, path.stat().st_size
    if pixels > max_pixels:
        return f"{image.width}x{image.height} pixels, more than the {max_pixels:,} read at most"
    if pixels * channels > max(MAX_PIXELS, MAX_EXPANSION * size):
        return f"{image.width}x{image.height} pixels in a file of {size:,} bytes, which no photo comes to"
    return ""
