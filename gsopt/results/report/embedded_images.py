"""Images embedded in a page as data URIs: thumbnails, error maps, an animation."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from gsopt.data.files import is_regular
from gsopt.results.video import write_video

WEBP_QUALITY = 88
ERROR_FULL_SCALE = 0.25
"""Mean absolute difference of the three channels (of 1) at which the color scale ends; the same for every view."""
# Dark to bright, so that it is readable in gray too: error, red, green, blue.
ERROR_COLORS = (
    (0.00, 13, 16, 33),
    (0.25, 43, 76, 155),
    (0.50, 24, 169, 153),
    (0.75, 242, 193, 78),
    (1.00, 255, 246, 230),
)


def shrunk(image: Image.Image, side: int) -> Image.Image:
    """The image scaled down to fit into a square of `side` px."""
    copy = image.copy()
    copy.thumbnail((side, side), Image.Resampling.LANCZOS)
    return copy


def read_image(path: Path, side: int, max_pixels: int) -> Image.Image | None:
    """A PNG scaled down to fit into a square of `side` px, or None for a file that is missing, too large or no PNG."""
    if not is_regular(path):
        return None
    try:
        with Image.open(path, formats=("PNG",)) as image:
            return shrunk(image.convert("RGB"), side) if image.width * image.height <= max_pixels else None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def data_uri(image: Image.Image) -> str:
    """The image as the data URI of a WebP."""
    buffer = io.BytesIO()
    image.save(buffer, format="WEBP", quality=WEBP_QUALITY, method=4)
    return _uri(buffer.getvalue())


def animation_uri(images: Sequence[Image.Image], fps: float) -> str:
    """The images as the data URI of an endless animated WebP."""
    buffer = io.BytesIO()
    write_video(buffer, iter(images), ".webp", fps)
    return _uri(buffer.getvalue())


def error_map(render: Image.Image, truth: Image.Image) -> Image.Image:
    """Mean absolute difference over the channels, colored from 0 to ERROR_FULL_SCALE and more."""
    a, b = (np.asarray(image, dtype=np.float64) / 255 for image in (render, truth))
    level = np.clip(np.abs(a - b).mean(axis=2) / ERROR_FULL_SCALE, 0, 1)
    stops = np.array(ERROR_COLORS)
    channels = [np.interp(level, stops[:, 0], stops[:, 1 + channel]) for channel in range(3)]
    return Image.fromarray(np.stack(channels, axis=2).round().astype(np.uint8))


def error_legend() -> str:
    """The color scale of `error_map` as HTML."""
    stops = ", ".join(f"rgb({red} {green} {blue}) {at:.0%}" for at, red, green, blue in ERROR_COLORS)
    return (
        f'<p class="legend"><span>Error 0</span><i style="background:linear-gradient(90deg, {stops})"></i>'
        f"<span>{ERROR_FULL_SCALE:g} and more (mean absolute difference of the channels, of 1)</span></p>"
    )


def _uri(data: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")
