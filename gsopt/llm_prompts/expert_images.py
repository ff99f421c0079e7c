"""Reads the expert's photos for language models and CLIP: image files, a folder of them, or a dataset's input views."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS, bomb
from gsopt.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from gsopt.data.scene import View

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
MAX_PIXELS = 64 << 20
"""Size limit of an image, pixels."""
KEPT_SIDE = 512
"""Longer side of the images in memory, px."""
SENT_SIDE = 384
"""Longer side of the images sent to a language model, px."""
MAX_IMAGES = 8
MAX_SENT_IMAGES = 4


def read_views(paths: Sequence[Path], most: int = MAX_IMAGES) -> tuple[Image.Image, ...]:
    """Returns at most `most` reduced images on white, evenly spread over the paths.

    Raises InputError for a missing, broken or too large image.
    """
    if len(paths) == 1 and _is_dataset(paths[0]):
        return _input_views(paths[0], most)
    files = [file for path in paths for file in (_images_in(path) if path.is_dir() else [path])]
    step = max(1, -(-len(files) // most))
    return tuple(_read(file) for file in files[::step])


def to_jpegs(images: Sequence[Image.Image]) -> tuple[bytes, ...]:
    """Returns a few of the images as small JPEG files without metadata."""
    step = max(1, -(-len(images) // MAX_SENT_IMAGES))
    return tuple(_jpeg(image) for image in images[::step])


def to_squares(images: Sequence[Image.Image], size: int) -> Float[Tensor, "B 3 S S"]:
    """Returns the center squares, 0..1."""
    import torch

    squares = []
    for image in images:
        side = min(image.size)
        left, top = (image.width - side) // 2, (image.height - side) // 2
        square = image.resize((size, size), Image.Resampling.LANCZOS, (left, top, left + side, top + side))
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
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            if reason := bomb(image, path, max_pixels=MAX_PIXELS):
                raise ValueError(f"{reason}: too large")
            return _on_white(image.convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"Cannot read the image {path}: {error}. Give a PNG, JPEG or WebP file.") from error


def _on_white(rgba: Image.Image) -> Image.Image:
    image = Image.alpha_composite(Image.new("RGBA", rgba.size, "white"), rgba).convert("RGB")
    image.thumbnail((KEPT_SIDE, KEPT_SIDE), Image.Resampling.LANCZOS)
    return image


def _jpeg(image: Image.Image) -> bytes:
    small = image.copy()
    small.thumbnail((SENT_SIDE, SENT_SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, format="JPEG", quality=85)
    return buffer.getvalue()


def _input_views(folder: Path, most: int) -> tuple[Image.Image, ...]:
    from gsopt.config.train import DataConfig
    from gsopt.data.scene import load_scene

    views = load_scene(DataConfig(path=str(folder))).train
    step = max(1, -(-len(views) // most))
    return tuple(_view_image(view) for view in views[::step])


def _view_image(view: View) -> Image.Image:
    image = Image.fromarray(view.pixels().contiguous().numpy())
    return _on_white(image.convert("RGBA"))
