"""The three files of a COLMAP model, binary and text, as plain records."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from gsopt.data import files
from gsopt.errors import InputError, shortened

CAMERA_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
"""Name and number of parameters; the row is COLMAP's model id."""
_REMEDY = "Export the model again."


@dataclass(frozen=True)
class CameraRecord:
    camera_id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    name: str
    camera_id: int
    quat: tuple[float, float, float, float]
    """wxyz, camera from world."""
    translation: tuple[float, float, float]


def read_cameras(path: Path) -> dict[int, CameraRecord]:
    """Cameras by id. InputError on anything broken."""
    records = _cameras_binary(_Cursor(path)) if path.suffix == ".bin" else _cameras_text(path)
    return {record.camera_id: record for record in records}


def read_images(path: Path) -> list[ImageRecord]:
    """Posed images in file order. InputError on anything broken, or when there is none."""
    records = list(_images_binary(_Cursor(path)) if path.suffix == ".bin" else _images_text(path))
    if not records:
        raise InputError(f"{path} poses no image. Run the reconstruction again with more overlap between photos.")
    return records


def read_points(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Positions and colors. InputError on anything broken."""
    rows = list(_points_binary(_Cursor(path)) if path.suffix == ".bin" else _points_text(path))
    xyz = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([row[3:] for row in rows], dtype=np.uint8).reshape(-1, 3)
    return xyz, rgb


class _Cursor:
    """Reads a binary file front to back and never past its end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise InputError(f"Cannot read {path}: {error.strerror or error}. {_REMEDY}") from error
        self._offset = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        end = self._offset + layout.size
        if end > len(self._data):
            raise InputError(f"{self.path} ends in the middle of a record (byte {len(self._data):,}). {_REMEDY}")
        values = layout.unpack_from(self._data, self._offset)
        self._offset = end
        return values

    def count(self, smallest_record: int) -> int:
        """A record count, refused when the rest of the file cannot hold that many."""
        declared: int = self.take(_COUNT)[0]
        if declared * smallest_record > len(self._data) - self._offset:
            raise InputError(
                f"{self.path} declares {declared:,} records, more than its {len(self._data):,} bytes hold. {_REMEDY}"
            )
        return declared

    def text(self) -> str:
        """Characters up to the next zero byte."""
        end = self._data.find(b"\0", self._offset)
        if end < 0:
            raise InputError(f"{self.path} ends in the middle of an image name. {_REMEDY}")
        value = self._data[self._offset : end].decode("utf-8", "surrogateescape")
        self._offset = end + 1
        return value

    def skip(self, size: int) -> None:
        self._offset += size


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_KEYPOINT_BYTES = 24
_TRACK_BYTES = 8


def _cameras_binary(cursor: _Cursor) -> Iterator[CameraRecord]:
    for _ in range(cursor.count(_CAMERA.size + 3 * 8)):
        camera_id, model, width, height = cursor.take(_CAMERA)
        if not 0 <= model < len(CAMERA_MODELS):
            raise InputError(f"Camera {camera_id} in {cursor.path} has unknown model id {model}. Export it as OPENCV.")
        name, size = CAMERA_MODELS[model]
        yield CameraRecord(camera_id, name, width, height, cursor.take(struct.Struct(f"<{size}d")))


def _images_binary(cursor: _Cursor) -> Iterator[ImageRecord]:
    for _ in range(cursor.count(_IMAGE.size + 1 + _COUNT.size)):
        _, qw, qx, qy, qz, tx, ty, tz, camera_id = cursor.take(_IMAGE)
        name = cursor.text()
        cursor.skip(cursor.count(_KEYPOINT_BYTES) * _KEYPOINT_BYTES)
        yield ImageRecord(name, camera_id, (qw, qx, qy, qz), (tx, ty, tz))


def _points_binary(cursor: _Cursor) -> Iterator[tuple[float, ...]]:
    for _ in range(cursor.count(_POINT.size + _COUNT.size)):
        row = cursor.take(_POINT)
        cursor.skip(cursor.count(_TRACK_BYTES) * _TRACK_BYTES)
        yield row[1:7]


def _cameras_text(path: Path) -> Iterator[CameraRecord]:
    sizes = dict(CAMERA_MODELS)
    for line, words in _records(path):
        try:
            model = words[1]
            params = tuple(float(word) for word in words[4:])
            if model not in sizes or len(params) != sizes[model]:
                raise ValueError(f"model {model} with {len(params)} parameters")
            yield CameraRecord(int(words[0]), model, int(words[2]), int(words[3]), params)
        except (ValueError, IndexError) as error:
            raise _bad_line(path, line, error) from error


def _images_text(path: Path) -> Iterator[ImageRecord]:
    """Two lines an image: the pose, then its keypoints (unused, may be empty)."""
    lines = enumerate(files.read_lines(path), start=1)
    for line, text in lines:
        if not text.strip() or text.startswith("#"):
            continue
        try:
            words = text.strip().split(maxsplit=9)
            _, qw, qx, qy, qz, tx, ty, tz = (float(word) for word in words[:8])
            yield ImageRecord(words[9], int(words[8]), (qw, qx, qy, qz), (tx, ty, tz))
        except (ValueError, IndexError) as error:
            raise _bad_line(path, line, error) from error
        next(lines, None)


def _points_text(path: Path) -> Iterator[tuple[float, ...]]:
    for line, words in _records(path):
        try:
            rgb = [int(word) for word in words[4:7]]
            if len(rgb) != 3 or not 0 <= min(rgb) <= max(rgb) <= 255:
                raise ValueError(f"color {words[4:7]}")
            yield (*(float(word) for word in words[1:4]), *rgb)
        except (ValueError, IndexError) as error:
            raise _bad_line(path, line, error) from error


def _records(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(line number, words) of every line that is neither empty nor a comment."""
    for line, text in enumerate(files.read_lines(path), start=1):
        if text.strip() and not text.startswith("#"):
            yield line, text.split()


def _bad_line(path: Path, line: int, error: Exception) -> InputError:
    return InputError(f"{path}, line {line}, is not as COLMAP writes it: {shortened(str(error))}. {_REMEDY}")
