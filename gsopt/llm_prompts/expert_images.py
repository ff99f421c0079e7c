"""The expert's photos, for models that see and for CLIP: image files, a folder of them, or a dataset's input views."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from gsopt.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from gsopt.data.scene import View

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")
LARGEST = 64 << 20
"""Pixels of an image that is opened."""
SIDE = 512
"""Longer side of what is kept, px."""
SENT_SIDE = 384
"""Longer side of what a language model is sent, px."""
MOST = 8
MOST_SENT = 4


def read_views(paths: Sequence[Path], most: int = MOST) -> tuple[Image.Image, ...]:
    """At most `most` pictures, evenly spread over what the paths name, on white, made small.

    Raises InputError for what is no image, too large or not there.
    """
    if len(paths) == 1 and _is_dataset(paths[0]):
        return _input_views(paths[0], most)
    files = [file for path in paths for file in (_images_in(path) if path.is_dir() else [path])]
    step = max(1, -(-len(files) // most))
    return tuple(_read(file) for file in files[::step])


def to_jpegs(pictures: Sequence[Image.Image]) -> tuple[bytes, ...]:
    """A few of the pictures as small JPEG files without any metadata."""
    step = max(1, -(-len(pictures) // MOST_SENT))
    return tuple(_jpeg(picture) for picture in pictures[::step])


def to_squares(pictures: Sequence[Image.Image], size: int) -> Float[Tensor, "B 3 S S"]:
    """Their middle squares, 0..1."""
    import torch

    squares = []
    for picture in pictures:
        side = min(picture.size)
        left, top = (picture.width - side) // 2, (picture.height - side) // 2
        square = picture.resize((size, size), Image.Resampling.LANCZOS, (left, top, left + side, top + side))
        pixels = torch.frombuffer(bytearray(square.tobytes()), dtype=torch.uint8)
        squares.append(pixels.view(size, size, 3).permute(2, 0, 1) / 255)
    return torch.stack(squares) if squares else torch.empty(0, 3, size, size)


def _is_dataset(path: Path) -> bool:
    return path.is_dir() and (any(path.glob("transforms*.json")) or (path / "sparse").is_dir())


def _images_in(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
    if not files:
        raise InputError(f"`--images` {folder} holds no images and no dataset. Give image files or a dataset folder.")
    return files


def _read(path: Path) -> Image.Image:
    try:
        if not path.is_file():
            raise OSError("no such file")
        with Image.open(path, formats=FORMATS) as image:
            if image.width * image.height > LARGEST:
                raise ValueError(f"{image.width} x {image.height} px is too large")
            return _on_white(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"Cannot read the image {path}: {error}. Give a PNG, JPEG or WebP file.") from error


def _on_white(rgba: Image.Image) -> Image.Image:
    picture = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba).convert("RGB")
    picture.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    return picture


def _jpeg(picture: Image.Image) -> bytes:
    small = picture.copy()
    small.thumbnail((SENT_SIDE, SENT_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=85)
    return buffer.getvalue()


def _input_views(folder: Path, most: int) -> tuple[Image.Image, ...]:
    from gsopt.config.train import DataConfig
    from gsopt.data.scene import load_scene

    views = load_scene(DataConfig(path=str(folder))).train
    step = max(1, -(-len(views) // most))
    return tuple(_picture(view) for view in views[::step])


def _picture(view: View) -> Image.Image:
    image = Image.fromarray(view.pixels().contiguous().numpy())
    return _on_white(image.convert("RGBA"))
