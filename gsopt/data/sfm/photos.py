"""Input photos: decoded, turned upright and measured, or rejected with a reason."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError

from gsopt.data import files
from gsopt.data.image_files import IMAGE_FORMATS, bomb, write_image
from gsopt.errors import InputError

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif")
HEIC = (".heic", ".heif")
PHOTO_FORMATS = ("AVIF", "HEIF")
"""Read besides IMAGE_FORMATS where Pillow, or gsopt[heic], has the decoder."""
MIN_PHOTO_SIDE = 160
"""Smaller photos hold too few features to be placed, px."""
COPY_RMS = 1.0
"""Thumbnails whose gray levels (0..255) differ by less show the same photo."""
THUMBNAIL_SIDE = 32
SHARPNESS_SIDE = 640
"""Sharpness is measured at this size, so that photos of different sizes compare."""
_DIAGONAL_35MM = math.hypot(36, 24)
_LOSSLESS = ("PNG", "BMP", "TIFF")


@dataclass(frozen=True)
class Photo:
    """A photo that can be used: upright, in the working folder under its final name."""

    name: str
    """File name in the scene; unique, without blanks."""
    source: Path
    """The file it came from."""
    path: Path
    width: int
    height: int
    """Size of the upright photo."""
    camera: str
    """Photos with the same text were taken by the same lens at the same zoom and size."""
    focal: float | None
    """Pixels, from EXIF."""
    sharpness: float
    has_alpha: bool
    thumbnail: Float32[np.ndarray, "32 32"]
    """Gray levels, 0..255."""

    @property
    def contrast(self) -> float:
        """Standard deviation of the thumbnail."""
        return float(self.thumbnail.std())


@dataclass(frozen=True)
class RejectedFile:
    """A file that was left out before anything was computed."""

    name: str
    reason: str


def find_photos(folder: Path) -> list[Path]:
    """The photos of a folder, else of its folder images/, in natural order (2 before 10). InputError without any."""
    for place in (folder, folder / "images"):
        found = sorted(_photo_files(place), key=lambda path: natural(path.name))
        if found:
            return found
    raise InputError(
        f"{folder} holds no photos. Looked for {', '.join(SUFFIXES)} in it and in images/. Give another folder."
    )


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key that counts numbers inside a name as numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name)]


def read_photos(paths: list[Path], work: Path) -> tuple[list[Photo], list[RejectedFile]]:
    """Upright photos in WORK/photos, copies of an earlier one left out, and what was refused."""
    folder = work / "photos"
    folder.mkdir(parents=True)
    photos: list[Photo] = []
    refused: list[RejectedFile] = []
    taken: set[str] = set()
    for path in paths:
        try:
            photo = read_photo(path, folder, taken)
        except InputError as error:
            refused.append(RejectedFile(path.name, str(error)))
            continue
        twin = next((other for other in photos if is_copy(photo, other)), None)
        if twin is None:
            photos.append(photo)
        else:
            refused.append(RejectedFile(path.name, f"a copy of {twin.name}: it adds nothing"))
            photo.path.unlink()
    return photos, refused


def read_photo(path: Path, folder: Path, taken: set[str]) -> Photo:
    """Decode one photo, turn it upright and put it into `folder`. InputError with the reason if it cannot be used."""
    image = _opened(path)
    try:
        exif = image.getexif()
        turned = exif.get(ExifTags.Base.Orientation, 1) not in (0, 1)
        kind = image.format or ""
        image.load()
        upright = ImageOps.exif_transpose(image) if turned else image
    except Exception as error:  # decoders raise nearly anything on a hostile file
        raise InputError(f"cannot be decoded ({_short(error)}). Copy it again from the camera") from error
    if min(upright.size) < MIN_PHOTO_SIDE:
        raise InputError(f"too small: {upright.width}x{upright.height} px. Take the original, not a preview")
    has_alpha = "A" in upright.getbands() or "transparency" in upright.info
    name = _scene_name(path, kind, has_alpha, taken)
    target = folder / name
    if turned or kind not in ("JPEG", "PNG") or upright.mode not in ("RGB", "RGBA", "L"):
        _save(upright.convert("RGBA" if has_alpha else "RGB"), target)
    else:
        target.symlink_to(path.absolute())
    gray = upright.convert("L")
    make = " ".join(str(exif.get(tag, "")).strip() for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    focal = focal_from_exif(exif, upright.size)
    zoom = "" if focal is None else f" f {focal:.0f}"
    return Photo(
        name=name,
        source=path,
        path=target,
        width=upright.width,
        height=upright.height,
        camera=f"{make.strip() or 'camera'} {upright.width}x{upright.height}{zoom}",
        focal=focal,
        sharpness=sharpness(gray),
        has_alpha=has_alpha,
        thumbnail=np.asarray(gray.resize((THUMBNAIL_SIDE, THUMBNAIL_SIDE), Image.Resampling.BOX), dtype=np.float32),
    )


def focal_from_exif(exif: Image.Exif, size: tuple[int, int]) -> float | None:
    """Focal length in pixels from the 35 mm equivalent, which is defined by the diagonal (CIPA DCG-001), or None.

    The diagonal is the same for a photo that is turned.
    """
    details = exif.get_ifd(ExifTags.IFD.Exif)
    try:
        equivalent = float(details.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if not 4 <= equivalent <= 2000:
        return None
    return equivalent / _DIAGONAL_35MM * math.hypot(*size)


def sharpness(gray: Image.Image) -> float:
    """Variance of the Laplacian relative to the variance of the photo: 0 for fog, about 1 for fine detail.

    The relative measure (after Pech-Pacheco et al. 2000) does not fall when a scene is dim or of low contrast.
    """
    scale = SHARPNESS_SIDE / max(gray.size)
    if scale < 1:
        size = (max(3, round(gray.width * scale)), max(3, round(gray.height * scale)))
        gray = gray.resize(size, Image.Resampling.BOX)
    z = np.asarray(gray, dtype=np.float32)
    laplacian = 4 * z[1:-1, 1:-1] - z[:-2, 1:-1] - z[2:, 1:-1] - z[1:-1, :-2] - z[1:-1, 2:]
    return float(laplacian.var() / max(float(z.var()), 1.0))


def is_copy(photo: Photo, other: Photo) -> bool:
    """True when two files show the same photo, re-encoded or not."""
    if photo.width * other.height != photo.height * other.width:
        return False
    return float(np.sqrt(np.square(photo.thumbnail - other.thumbnail).mean())) < COPY_RMS


def _photo_files(folder: Path) -> Iterator[Path]:
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and files.is_regular(path):
            yield path


def _opened(path: Path) -> Image.Image:
    if path.suffix.lower() in HEIC and not _reads_heic():
        raise InputError("HEIC needs a decoder: pip install 'gsopt[heic]', or export the photo as JPEG")
    if path.stat().st_size == 0:
        raise InputError("is empty (0 bytes). Copy it again from the camera")
    Image.init()
    formats = (*IMAGE_FORMATS, *(name for name in PHOTO_FORMATS if name in Image.OPEN))
    try:
        image = Image.open(path, formats=formats)
    except UnidentifiedImageError as error:
        raise InputError(
            f"is no image, whatever its name says; read are {', '.join(formats)}. Copy it again from the camera"
        ) from error
    except Exception as error:
        raise InputError(f"cannot be decoded ({_short(error)}). Copy it again from the camera") from error
    if reason := bomb(image, path):
        image.close()
        raise InputError(f"too large: {reason}. Scale it down, or save it again")
    return image


def _reads_heic() -> bool:
    """Registers the decoder where it is installed."""
    try:
        import pillow_heif
    except ImportError:
        return False
    pillow_heif.register_heif_opener()
    return True


def _scene_name(path: Path, kind: str, has_alpha: bool, taken: set[str]) -> str:
    """A name without blanks (COLMAP's lists are split at them) that no earlier photo has; adds it to `taken`."""
    stem = re.sub(r"[^\w.+-]", "_", path.stem) or "photo"
    suffix = ".png" if has_alpha or kind in _LOSSLESS else ".jpg"
    name, n = stem + suffix, 2
    while name.lower() in taken:
        name, n = f"{stem}_{n}{suffix}", n + 1
    taken.add(name.lower())
    return name


def _save(image: Image.Image, path: Path) -> None:
    options: dict[str, Any] = {"quality": 97, "subsampling": 0} if path.suffix == ".jpg" else {"compress_level": 3}
    write_image(image, path, exif=Image.Exif(), **options)
    os.chmod(path, 0o644)


def _short(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:120]
