"""Pixels on demand: decode, mask, undistort, downscale, and keep what fits in the cache.

Pixel data are taken as stored: an EXIF orientation tag is ignored, because poses and intrinsics of every supported
dataset refer to the stored rows and columns.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from gsopt.data import files
from gsopt.data.image_files import IMAGE_FORMATS, bomb
from gsopt.data.masks import apply_mask
from gsopt.data.resample import area_downscale, downscaled, premultiply, unpremultiply
from gsopt.data.undistort import Undistortion, undistort
from gsopt.errors import InputError

_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")


@dataclass(frozen=True)
class ImageSource:
    """One image file and its way to working pixels."""

    path: Path
    mask: Path | None
    stored: tuple[int, int]
    """Width and height the file must have."""
    undistortion: Undistortion | None
    """Absent for a pinhole lens."""
    width: int
    height: int
    """Working size, never larger than `stored`."""


class ImageStore:
    """The images of a scene. Several threads may call `get`; tensors are shared, so never write to one."""

    def __init__(self, sources: Sequence[ImageSource], cache_mb: int) -> None:
        self.sources = tuple(sources)
        self._budget = cache_mb * (1 << 20)
        self._used = 0
        self._cache: OrderedDict[int, Tensor] = OrderedDict()
        self._grid: tuple[Undistortion, Tensor] | None = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.sources)

    @property
    def cached_bytes(self) -> int:
        """Bytes of decoded pixels held now; never above the budget."""
        return self._used

    def get(self, index: int) -> UInt8[Tensor, "H W C"]:
        """Image `index`: 3 channels, or 4 with straight alpha. InputError naming the file when it cannot be decoded."""
        with self._lock:
            if index in self._cache:
                self._cache.move_to_end(index)
                return self._cache[index]
        pixels = self._load(self.sources[index])  # outside the lock, so that threads decode side by side
        with self._lock:
            self._keep(index, pixels)
        return pixels

    def _keep(self, index: int, pixels: Tensor) -> None:
        if pixels.nbytes > self._budget or index in self._cache:
            return
        self._cache[index] = pixels
        self._used += pixels.nbytes
        while self._used > self._budget:
            _, oldest = self._cache.popitem(last=False)
            self._used -= oldest.nbytes

    def _load(self, source: ImageSource) -> Tensor:
        pixels = read_pixels(source.path)
        if (pixels.shape[1], pixels.shape[0]) != source.stored:
            raise size_mismatch(source.path, (pixels.shape[1], pixels.shape[0]), source.stored)
        if source.mask is not None:
            pixels = apply_mask(pixels, read_gray(source.mask, source.stored), source.mask)
        if source.undistortion is None and source.stored == (source.width, source.height):
            return pixels
        if source.undistortion is None:
            return downscaled(pixels, source.width, source.height)
        planes = undistort(premultiply(pixels), self._sample_grid(source.undistortion))
        return unpremultiply(area_downscale(planes, source.width, source.height))

    def _sample_grid(self, undistortion: Undistortion) -> Float[Tensor, "H W 2"]:
        """The grid of one camera is kept: photos of one lens follow each other."""
        kept = self._grid
        if kept is None or kept[0] is not undistortion:
            kept = (undistortion, undistortion.sample_grid())
            self._grid = kept
        return kept[1]


def size_mismatch(path: Path, got: tuple[int, int], declared: tuple[int, int]) -> InputError:
    """The error for an image whose size differs from its dataset's."""
    return InputError(
        f"{path} is {got[0]}x{got[1]} pixels, but the dataset declares {declared[0]}x{declared[1]}. "
        "Restore the original image, or export the poses again for this size."
    )


def read_header(path: Path) -> tuple[int, int, bool]:
    """Width, height, and True when there is alpha; without decoding."""
    with _open(path) as image:
        return image.width, image.height, _has_alpha(image)


def read_pixels(path: Path) -> UInt8[Tensor, "H W C"]:
    """Decode to RGB, or to RGBA (straight) when the file has alpha."""
    with _open(path) as image:
        return _decode(image, "RGBA" if _has_alpha(image) else "RGB", path)


def check_mask_size(path: Path, got: tuple[int, int], size: tuple[int, int]) -> None:
    """InputError unless a mask has the aspect of its image; sizes are (width, height)."""
    if abs(got[0] * size[1] - got[1] * size[0]) > max(*got, *size):
        raise InputError(
            f"The mask {path} is {got[0]}x{got[1]}, but its image is {size[0]}x{size[1]}: another aspect. "
            "Export the mask again for this image."
        )


def read_gray(path: Path, size: tuple[int, int]) -> UInt8[Tensor, "H W"]:
    """Decode to one channel of `size`; another size is box-filtered to it when the aspect agrees, else InputError."""
    with _open(path, channels=1) as image:
        width, height = image.size
        check_mask_size(path, (width, height), size)
        gray = _decode(image, "L", path)
    if (width, height) == size:
        return gray[..., 0]
    resized = Image.fromarray(gray[..., 0].numpy()).resize(size, Image.Resampling.BOX)
    return torch.from_numpy(np.array(resized))


def _open(path: Path, channels: int = 4) -> Image.Image:
    if not files.is_regular(path):
        raise InputError(f"The image {path} is not a readable file. Restore it, or remove its frame.")
    try:
        image = Image.open(path, formats=IMAGE_FORMATS)
    except Exception as error:  # decoders raise nearly anything on a hostile file
        raise _undecodable(path, error) from error
    if reason := bomb(image, path, channels):
        image.close()
        raise InputError(f"{path} declares {reason}. Downscale it first, or save it again.")
    return image


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in _ALPHA_MODES or "transparency" in image.info


def _decode(image: Image.Image, mode: str, path: Path) -> UInt8[Tensor, "H W C"]:
    try:
        if image.mode == "F":
            raise ValueError("its pixels are floating-point numbers, whose range is unknown; 8 bit are read")
        if image.mode.startswith("I"):  # 16-bit gray: Pillow would clip it to 255 instead of scaling
            wide = np.asarray(image, dtype=np.int64)
            few = mode == "L" and wide.max() <= 255  # a mask of 0 and 1, or of 0 and 255
            image = Image.fromarray(np.clip(wide >> (0 if few else 8), 0, 255).astype(np.uint8))
        array = np.array(image.convert(mode))
    except Exception as error:
        raise _undecodable(path, error) from error
    return torch.from_numpy(array if array.ndim == 3 else array[..., None])


def _undecodable(path: Path, error: Exception) -> InputError:
    reason = str(error) or type(error).__name__
    return InputError(
        f"Cannot decode {path}: {reason}. Restore the file, or remove its frame ({', '.join(IMAGE_FORMATS)})."
    )
