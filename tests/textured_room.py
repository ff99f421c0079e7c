"""Photos of a textured room corner with a box in it: drawn plane by plane, so that every pose is known exactly."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageFilter

from gsopt.data.sfm.settings import SfmConfig
from gsopt.geometry.cameras import look_at

WIDTH, HEIGHT, FOCAL = 400, 300, 380.0
TEXTURE = 512
QUICK = SfmConfig(features="sift", max_features=1200, threads=1)
"""Finds the poses of these photos in a few seconds."""
Corners = tuple[tuple[float, float, float], ...]
# Each plane: the world positions of its texture's corners (top left, top right, bottom right, bottom left).
PLANES: tuple[Corners, ...] = (
    ((-3, 3, 0), (3, 3, 0), (3, -3, 0), (-3, -3, 0)),  # floor
    ((-3, 3, 3), (3, 3, 3), (3, 3, 0), (-3, 3, 0)),  # back wall
    ((-3, -3, 3), (-3, 3, 3), (-3, 3, 0), (-3, -3, 0)),  # left wall
    ((-0.5, 0.5, 0.8), (0.5, 0.5, 0.8), (0.5, -0.5, 0.8), (-0.5, -0.5, 0.8)),  # top of the box
    ((-0.5, -0.5, 0.8), (0.5, -0.5, 0.8), (0.5, -0.5, 0), (-0.5, -0.5, 0)),  # its front
    ((0.5, -0.5, 0.8), (0.5, 0.5, 0.8), (0.5, 0.5, 0), (0.5, -0.5, 0)),  # its right side
)


def arc(count: int, spread: float = 60.0, radius: float = 4.0) -> torch.Tensor:
    """viewmats (float64) of cameras on an arc of `spread` degrees that look at the box."""
    angles = torch.deg2rad(torch.linspace(-90, -90 + spread, count, dtype=torch.float64) + 15)
    heights = 1.8 + 0.3 * torch.sin(torch.arange(count, dtype=torch.float64))
    eyes = torch.stack([radius * angles.cos(), radius * angles.sin(), heights], dim=1)
    target = torch.tensor([0, 0, 0.5], dtype=torch.float64)
    return look_at(eyes, target, torch.tensor([0, 0, 1], dtype=torch.float64))


def draw(viewmat: torch.Tensor, seed: int = 0) -> Image.Image:
    """One photo; another seed is another room."""
    picture = Image.new("RGB", (WIDTH, HEIGHT), (40, 40, 40))
    for index, plane in enumerate(PLANES):
        corners = np.array([project(viewmat, corner) for corner in plane])
        texture = textures(seed)[index]
        size = (WIDTH, HEIGHT)
        coefficients = homography(corners, np.array([(0, 0), (TEXTURE, 0), (TEXTURE, TEXTURE), (0, TEXTURE)]))
        warped = texture.transform(size, Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BICUBIC)
        cover = Image.new("L", texture.size, 255)
        mask = cover.transform(size, Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BILINEAR)
        picture.paste(warped, (0, 0), mask)
    return picture


_TEXTURES: dict[int, list[Image.Image]] = {}


def textures(seed: int) -> list[Image.Image]:
    """Blobs of many sizes: features at every distance."""
    if seed not in _TEXTURES:
        generator = np.random.default_rng(seed)
        _TEXTURES[seed] = [_texture(generator) for _ in PLANES]
    return _TEXTURES[seed]


def _texture(generator: np.random.Generator) -> Image.Image:
    total = np.zeros((TEXTURE, TEXTURE, 3))
    for cells in (8, 24, 64, 128):
        noise = Image.fromarray(generator.integers(0, 256, (cells, cells, 3), dtype=np.uint8))
        total += np.asarray(noise.resize((TEXTURE, TEXTURE), Image.Resampling.BICUBIC), dtype=np.float64) / 4
    stretched = np.clip((total - 128) * 2.2 + 128, 0, 255).astype(np.uint8)
    return Image.fromarray(stretched).filter(ImageFilter.SHARPEN)


def project(viewmat: torch.Tensor, corner: tuple[float, float, float]) -> tuple[float, float]:
    t = viewmat @ torch.tensor([*corner, 1.0], dtype=torch.float64)
    depth = max(float(t[2]), 0.05)
    return FOCAL * float(t[0]) / depth + WIDTH / 2, FOCAL * float(t[1]) / depth + HEIGHT / 2


def homography(source: np.ndarray, target: np.ndarray) -> list[float]:
    """The eight numbers that take `source` to `target`, as Pillow wants them."""
    rows, values = [], []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    return np.linalg.solve(np.array(rows), np.array(values)).tolist()


def photograph(folder: Path, viewmats: torch.Tensor, seed: int = 0, first: int = 0, exif: bool = True) -> list[str]:
    """Write one JPEG per camera, with the focal length in EXIF; returns the names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for index, viewmat in enumerate(viewmats, start=first):
        name = f"room_{index:02d}.jpg"
        draw(viewmat, seed).save(folder / name, quality=95, exif=focal_exif() if exif else Image.Exif())
        names.append(name)
    return names


def focal_exif() -> Image.Exif:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = round(FOCAL * math.hypot(36, 24) / math.hypot(WIDTH, HEIGHT))
    return exif
