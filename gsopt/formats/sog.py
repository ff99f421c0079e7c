"""PlayCanvas' .sog: a zip of meta.json and lossless WebP images with one pixel per splat.

Specification: developer.playcanvas.com, "The SOG Format", version 2. Positions have 16 bits between extremes of
sign(x) ln(1 + |x|); scales and base colors are entries of codebooks; the bands above are entries of a palette of
harmonics. Frame and meaning are those of a PLY.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsopt._version import __version__
from gsopt.errors import InputError, shortened
from gsopt.formats import sog_codes as codes
from gsopt.formats.compression import check_budget
from gsopt.formats.files import opened, replacing
from gsopt.formats.units import UNKNOWN, Units
from gsopt.formats.validation import BANDS, storable
from gsopt.gaussians import Gaussians
from gsopt.geometry.morton import morton_order

META = "meta.json"
_MAX_META = 1 << 17
"""Bytes; a meta.json has about 12 kB. Parsed JSON takes up to 25 times its text."""
_PIXEL_COST = 24
"""Bytes that Pillow takes per pixel while it decodes a WebP."""
_IMAGE_RATIO, _PALETTE_RATIO = 10, _PIXEL_COST
"""Times the file's size that this may be; trained palettes take fewer bytes than pixels in some files of peers."""
_UNCHECKED_SHARE = 0.1
"""Splats per byte of a file; images of more are all decoded once before any is kept."""
_MAX_LOG_MEAN = 88.0
"""Extremes of positions; exp(88) is near the end of float32."""
_SPARE_PIXELS = 1 << 14
"""Pixels that an image may have beyond twice the number of splats; encoders fill their last row."""
_MAX_SPLATS = 1 << 28
_ENTRIES = 256
_ROW_PIXELS = 64
"""Palette entries in one row of the image of centroids."""
_TIME = (1980, 1, 1, 0, 0, 0)
"""Time stamp of every member, so that equal splats give equal bytes."""
_IMAGES = (("means", 0, 3), ("means", 1, 3), ("quats", 0, 4), ("scales", 0, 3), ("sh0", 0, 4))
"""Section, number and channels of every image with a pixel per splat, but that of the palette's labels."""
Pixels = NDArray[np.uint8]


def save_sog(path: Path, gaussians: Gaussians, *, antialiased: bool = False, units: Units = UNKNOWN) -> None:
    """Write a .sog with the splats in Morton order; needs no other file.

    Reading back differs by at most: means half of 1/65535 of their extent in sign(x) ln(1 + |x|); opacity 1/255; each
    component of the unit quaternion, up to its sign, 0.006; log-scales and sh0 by the distance to the nearest of 256
    values; bands 1 and up by that to the nearest of at most 65,536 palette entries.
    """
    if len(gaussians) == 0:
        raise InputError(f"{path}: a .sog must hold at least one splat, got 0. Use .ply.")
    gaussians = storable(gaussians, path)
    gaussians = gaussians.select(morton_order(gaussians.means.double().flip(-1)))
    images, meta = codes.encode(gaussians)
    meta |= {"asset": {"generator": f"gsopt {__version__}"}}
    meta |= {"model": "antialiased"} if antialiased else {}
    meta |= {"gsopt": units.notes()} if units.notes() else {}
    with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(META, _TIME), json.dumps(meta, separators=(",", ":")))
        for name, image in images.items():
            archive.writestr(zipfile.ZipInfo(name, _TIME), _webp(image))


def _webp(image: Pixels) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", lossless=True, exact=True, method=4)
    return buffer.getvalue()


def load_sog(path: Path) -> Gaussians:
    """Read a .sog of version 2.

    Images and members are bounded by the size of the file before they are decoded, and no value is looked up before
    every image was.
    """
    with opened(path) as (file, size), _archive(file, path) as archive:
        bundle = _Bundle(archive, _meta(archive, path), size, path)
        return bundle.gaussians()


def sog_antialiased(path: Path) -> bool:
    """True when the file records that its splats were optimized with the 2D filter of Mip-Splatting."""
    meta = sog_meta(path)
    return meta.get("model") == "antialiased" or meta.get("antialias") is True


def sog_meta(path: Path) -> Mapping[str, Any]:
    """The meta.json of a .sog."""
    with opened(path) as (file, _), _archive(file, path) as archive:
        return _meta(archive, path)


def _archive(file: BinaryIO, path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(file)
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError) as error:
        raise InputError(f"{path} is no .sog, a zip of images: {shortened(str(error))}. Check the path.") from error


def _member(archive: zipfile.ZipFile, name: str, limit: int, path: Path) -> bytes:
    """The bytes of one member, at most `limit` of them."""
    try:
        with archive.open(name) as member:
            data = member.read(limit + 1)
    except KeyError as error:
        raise InputError(f"{path} lacks {shortened(name)}. Copy or export it again.") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        what = f"{shortened(name)} is damaged: {shortened(str(error))}"  # zipfile quotes names as long as the file
        raise InputError(f"{path}: {what}. Copy or export it again.") from error
    if len(data) > limit:
        raise InputError(f"{path}: {shortened(name)} has more than {limit} bytes. It is damaged or hostile.")
    return data


def _meta(archive: zipfile.ZipFile, path: Path) -> Mapping[str, Any]:
    try:
        meta = json.loads(_member(archive, META, _MAX_META, path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its meta.json is broken: {error}. Export it again.") from error
    if not isinstance(meta, dict) or meta.get("version") != 2:
        got = shortened(meta.get("version")) if isinstance(meta, dict) else type(meta).__name__
        raise InputError(f"{path}: .sog version must be 2, got {got}. Export it again.")
    return meta


def _rows(labels: Pixels) -> NDArray[np.integer]:
    """Numbers of palette entries from their low and high bytes."""
    return labels[:, 0] | labels[:, 1].astype(np.uint16) << 8


class _Bundle:
    """An opened .sog whose meta.json was read; every access checks the type it finds."""

    def __init__(self, archive: zipfile.ZipFile, meta: Mapping[str, Any], size: int, path: Path) -> None:
        self._archive, self._meta, self._size, self._path = archive, meta, size, path
        self._count = self._integer(meta, "count", _MAX_SPLATS)

    def gaussians(self) -> Gaussians:
        harmonics = self._meta.get("shN")
        bands = BANDS[self._integer(self._section("shN"), "bands", 3)] if harmonics else 0
        check_budget(4 * self._count * (14 + 3 * bands), self._size, self._path)
        mins, maxs = (self._floats(self._section("means"), key, 3) for key in ("mins", "maxs"))
        if max(np.abs(mins).max(), np.abs(maxs).max()) > _MAX_LOG_MEAN:
            self._fail(f"`mins` and `maxs` must lie within {_MAX_LOG_MEAN:g}, got {mins} and {maxs}")
        scales, colors = self._codebook("scales"), self._codebook("sh0")
        harmonics = self._codebook("shN") if bands else None
        if self._count > _UNCHECKED_SHARE * self._size:
            for _ in self._attributes(bands):
                pass  # a damaged image is found while only one is in memory
        low, high, quats, scale_codes, rgba, *palette = self._attributes(bands)
        return codes.decode(
            means=codes.unpack_means(low, high, mins, maxs),
            quats=quats,
            log_scales=scales[scale_codes],
            sh0=colors[rgba[:, :3]],
            opacities=rgba[:, 3],
            shN=np.zeros((self._count, 0, 3), np.float32)
            if harmonics is None
            else harmonics[palette[0]][_rows(palette[1])],
        )

    def _attributes(self, bands: int) -> Iterator[Pixels]:
        """Pixels [count, 3 or 4] of low and high bytes of positions, rotations, scales and colors; where there are
        bands the palette [entries, bands, 3] and its labels [count, 2]."""
        for key, index, channels in _IMAGES:
            yield self._splat_image(key, index, channels)
        if bands:
            section = self._section("shN")
            entries = self._integer(section, "count", 1 << 16)
            image = self._image(self._file(section, 0), (_ROW_PIXELS * bands, -(-entries // _ROW_PIXELS)))
            yield np.ascontiguousarray(image[..., :3].reshape(-1, bands, 3)[:entries])
            labels = self._splat_image("shN", 1, 2)
            greatest = int(_rows(labels).max())
            if greatest >= entries:
                self._fail(f"palette entry {greatest} of {entries} is used")
            yield labels

    def _splat_image(self, key: str, index: int, channels: int) -> Pixels:
        """[count, channels] pixels of an image with one per splat."""
        image = self._image(self._file(self._section(key), index), None)
        return np.ascontiguousarray(image.reshape(-1, 4)[: self._count, :channels])

    def _image(self, name: str, size: tuple[int, int] | None) -> Pixels:
        """[H, W, 4] pixels: of that (width, height), or at least one pixel per splat."""
        data = _member(self._archive, name, self._size, self._path)
        try:
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                width, height = image.size
                fits = self._count <= width * height <= 2 * self._count + _SPARE_PIXELS
                if (width, height) != size if size else not fits:
                    self._fail(f"{shortened(name)} has {width} x {height} pixels for {self._count} splats")
                ratio = _PALETTE_RATIO if size else _IMAGE_RATIO
                check_budget(_PIXEL_COST * width * height, self._size, self._path, ratio)
                image.load()
                return np.asarray(image if image.mode == "RGBA" else image.convert("RGBA"))
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise InputError(f"{self._path}: {shortened(name)} is no image: {error}. Export it again.") from error

    def _section(self, key: str) -> Mapping[str, Any]:
        value = self._meta.get(key)
        return value if isinstance(value, dict) else self._fail(f"`{key}` must be an object, got {shortened(value)}")

    def _file(self, section: Mapping[str, Any], index: int) -> str:
        files = section.get("files")
        if not isinstance(files, list) or len(files) <= index or not isinstance(files[index], str):
            self._fail(f"`files` must name {index + 1} images, got {shortened(files)}")
        return str(files[index])

    def _codebook(self, key: str) -> NDArray[np.float32]:
        return self._floats(self._section(key), "codebook", _ENTRIES)

    def _floats(self, section: Mapping[str, Any], key: str, count: int) -> NDArray[np.float32]:
        value = section.get(key)
        numbers = isinstance(value, list) and all(type(x) in (int, float) and abs(x) < 1e30 for x in value)
        if not isinstance(value, list) or not numbers or len(value) != count:
            self._fail(f"`{key}` must be {count} finite numbers, got {shortened(value)}")
        return np.array(value, np.float32)

    def _integer(self, section: Mapping[str, Any], key: str, greatest: int) -> int:
        value = section.get(key)
        if type(value) is not int or not 1 <= value <= greatest:
            self._fail(f"`{key}` must be 1 to {greatest}, got {shortened(value)}")
        return int(value)

    def _fail(self, what: str) -> NoReturn:
        raise InputError(f"{self._path}: {what}. Export it again.")
