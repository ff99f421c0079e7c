"""COLMAP's binary models, as far as cameras need them. Layout: colmap.github.io/format.html.

Lenses are read as pinholes; their distortion is left out, as `gsopt sfm` and COLMAP's undistorter leave none.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

LARGEST_FILE = 1 << 30
SHARED_FOCAL = (0, 2, 3, 8, 9)
"""SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL and the simple fisheyes: f, cx, cy."""
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}


@dataclass(frozen=True)
class Picture:
    """A posed picture."""

    name: str
    cam_from_world: NDArray[np.float64]
    """[4, 4] OpenCV axes."""
    width: int
    height: int
    focal: float
    """Horizontal, px."""
    center: tuple[float, float]


def model_folder(data: Path) -> Path | None:
    """Returns the folder of the model, or None."""
    places = (data / "sparse" / "0", data / "sparse", data / "colmap" / "sparse" / "0")
    return next((place for place in places if (place / "images.bin").is_file()), None)


def read_pictures(sparse: Path) -> list[Picture]:
    """InputError for a model that is damaged or cut short."""
    try:
        cameras = read_cameras(load(sparse / "cameras.bin"))
        return read_images(load(sparse / "images.bin"), cameras)
    except (OSError, struct.error, ValueError, KeyError, OverflowError) as error:
        raise InputError(f"The COLMAP model in {sparse} cannot be read: {error}. Make it again.") from error


def load(path: Path) -> bytes:
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"{path.name} is larger than {LARGEST_FILE} bytes")
    return path.read_bytes()


def read_cameras(data: bytes) -> dict[int, tuple[int, int, float, tuple[float, float]]]:
    """Camera id to width, height, focal length and center."""
    found = {}
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(min(count, len(data))):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        values = struct.unpack_from(f"<{PARAMETERS[model]}d", data, at + 24)
        at += 24 + 8 * PARAMETERS[model]
        center = values[1:3] if model in SHARED_FOCAL else values[2:4]
        if not values[0] > 0 or not np.isfinite(values).all() or not 0 < width < 2**31 or not 0 < height < 2**31:
            raise ValueError(f"camera {number} has no usable lens")
        found[number] = int(width), int(height), values[0], (center[0], center[1])
    return found


def read_images(data: bytes, cameras: dict[int, tuple[int, int, float, tuple[float, float]]]) -> list[Picture]:
    found = []
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(min(count, len(data))):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8", "replace")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError(f"images.bin ends within {name[:80]}")
        width, height, focal, center = cameras[camera]
        found.append(Picture(name, rigid(np.array(pose[:4]), np.array(pose[4:])), width, height, focal, center))
    return found


def rigid(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] of a rotation w, x, y, z and a translation."""
    length = np.linalg.norm(quaternion)
    if not length > 0:
        raise ValueError("a rotation has no length")
    w, x, y, z = quaternion / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix
