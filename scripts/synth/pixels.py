"""Passes to images: sRGB coding, PNG, contact sheets. numpy only, since Blender's own Python has no Pillow."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, UInt8

BACKDROP = (190, 190, 190)
"""Behind transparent pixels on a contact sheet."""


def srgb_from_linear(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The coding of IEC 61966-2-1, 0..1 to 0..1; light above 1 clips. It is Blender's view transform Standard."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)


def straight_rgba(color: Float32[np.ndarray, "H W 4"]) -> UInt8[np.ndarray, "H W 4"]:
    """sRGB-coded color and straight (not premultiplied) alpha of a linear, premultiplied render; black where empty."""
    alpha = np.clip(color[..., 3:], 0.0, 1.0)
    rgb = srgb_from_linear(color[..., :3] / np.maximum(alpha, 1e-6)) * (alpha > 0)
    return np.rint(255.0 * np.concatenate([rgb, alpha], axis=2)).astype(np.uint8)


def over(rgba: UInt8[np.ndarray, "H W 4"], background: tuple[int, int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """The image before a background, mixed in coded values as every trainer of the field mixes them."""
    alpha = rgba[..., 3:] / 255.0
    return np.rint(rgba[..., :3] * alpha + np.array(background) * (1.0 - alpha)).astype(np.uint8)


def png(pixels: UInt8[np.ndarray, "H W *C"]) -> bytes:
    """A PNG of 1, 3 or 4 channels without metadata: the same pixels are the same bytes."""
    rows = pixels.reshape(*pixels.shape[:2], -1)
    height, width, channels = rows.shape
    filtered = rows.copy()
    filtered[:, 1:] -= rows[:, :-1]  # PNG's filter Sub, modulo 256
    lines = np.concatenate([np.ones((height, 1), np.uint8), filtered.reshape(height, -1)], axis=1)
    kind = {1: 0, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def depth_picture(depth: Float32[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Near is bright, far is dark, nothing is the backdrop."""
    seen = depth > 0
    near, far = (depth[seen].min(), depth[seen].max()) if seen.any() else (0.0, 1.0)
    gray = 255.0 - 215.0 * (depth - near) / max(far - near, 1e-9)
    return np.where(seen[..., None], gray[..., None], BACKDROP).astype(np.uint8)


def normal_picture(normals: Float[np.ndarray, "H W 3"], seen: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """x, y, z from -1..1 to 0..255 in red, green, blue."""
    return np.where(seen[..., None], 127.5 + 127.5 * normals, BACKDROP).astype(np.uint8)


def contact_sheet(rows: Sequence[UInt8[np.ndarray, "N H W 3"]], most: int = 2048) -> UInt8[np.ndarray, "Y X 3"]:
    """Kinds of pictures under each other, each in as many lines as it needs, shrunk until the sheet is `most` wide."""
    columns = min(8, max(len(row) for row in rows))
    step = max(1, math.ceil(columns * rows[0].shape[2] / most))
    lines = [row[i : i + columns] for row in rows for i in range(0, len(row), columns)]
    return np.concatenate([line_of_tiles(line, columns, step) for line in lines])


def line_of_tiles(tiles: UInt8[np.ndarray, "N H W 3"], columns: int, step: int) -> UInt8[np.ndarray, "h X 3"]:
    """Tiles side by side, box-filtered by `step`; the line is filled up to `columns`."""
    height, width = (extent // step for extent in tiles.shape[1:3])
    blocks = tiles[:, : height * step, : width * step].reshape(-1, height, step, width, step, 3)
    line = np.empty((height, columns, width, 3), np.uint8)
    line[:] = BACKDROP
    line[:, : len(tiles)] = np.rint(blocks.mean(axis=(2, 4))).astype(np.uint8).swapaxes(0, 1)
    return line.reshape(height, columns * width, 3)
