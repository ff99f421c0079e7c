"""Small datasets written to a temporary folder, each in the form its own tool writes."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from gsopt.geometry.cameras import look_at, opengl_from_viewmats

SIZE = 16


def ring(count: int, radius: float = 4.0) -> torch.Tensor:
    """viewmats (float64) of cameras on a tilted ring that look at the origin."""
    angles = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    eyes = radius * torch.stack([angles.cos(), angles.sin(), 0.3 + 0.2 * (3 * angles).sin()], dim=1)
    return look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64))


def frames_of(viewmats: torch.Tensor, names: list[str]) -> list[dict[str, Any]]:
    poses = opengl_from_viewmats(viewmats).tolist()
    return [{"file_path": name, "transform_matrix": pose} for name, pose in zip(names, poses, strict=True)]


def save_image(path: Path, pixels: np.ndarray | None = None, mode: str = "RGBA", seed: int = 0) -> np.ndarray:
    """Write `pixels`, or noise that is opaque in the middle and transparent around it; returns what was written."""
    if pixels is None:
        pixels = np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, len(mode)), dtype=np.uint8)
        if mode == "RGBA":
            pixels[..., 3] = 0
            pixels[4:12, 4:12, 3] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return pixels


def nerf_synthetic(root: Path, train: int = 10, test: int = 3) -> Path:
    for split, count in (("train", train), ("test", test)):
        names = [f"./{split}/r_{i}" for i in range(count)]
        if not count:
            continue
        document = {"camera_angle_x": 0.7, "frames": frames_of(ring(count), names)}
        root.mkdir(parents=True, exist_ok=True)
        (root / f"transforms_{split}.json").write_text(json.dumps(document))
        for i, name in enumerate(names):
            save_image(root / (name + ".png"), seed=i)
    return root


def nerfstudio(root: Path, count: int = 10, size: tuple[int, int] = (SIZE, SIZE), **extra: Any) -> Path:
    """transforms.json in shuffled file order, RGB images in images/."""
    names = [f"images/{i:03d}.png" for i in range(count)]
    frames = frames_of(ring(count), names)
    document = {"fl_x": 20.0, "fl_y": 21.0, "cx": 7.5, "cy": 8.25, "w": size[0], "h": size[1], **extra}
    document["frames"] = frames[::2] + frames[1::2]
    for i, name in enumerate(names):
        pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        save_image(root / name, pixels)
    write_json(root, document)
    return root


def write_json(root: Path, document: dict[str, Any], name: str = "transforms.json") -> None:
    root.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(json.dumps(document))


def read_document(root: Path, name: str = "transforms.json") -> dict[str, Any]:
    return json.loads((root / name).read_text())


def quaternion(R: torch.Tensor) -> list[float]:
    """wxyz of a rotation, by the eigenvector of Bar-Itzhack's matrix: another way than the reader's."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    K = torch.tensor(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ],
        dtype=torch.float64,
    )
    return torch.linalg.eigh(K).eigenvectors[:, -1].tolist()


MODEL_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
MODEL_IDS |= {"FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10}
POINTS = [([0.5, -0.25, 2.0], [10, 20, 30], 2), ([1e-3, 7.0, -3.5], [255, 0, 128], 0)]
"""xyz, rgb, length of the track."""


def colmap(
    root: Path,
    count: int = 10,
    suffix: str = ".bin",
    model: str = "PINHOLE",
    params: tuple[float, ...] = (20.0, 21.0, 7.5, 8.25),
    size: tuple[int, int] = (SIZE, SIZE),
    viewmats: torch.Tensor | None = None,
) -> Path:
    """A reconstruction with one camera, images/ and two points; images are listed in reverse name order."""
    viewmats = ring(count) if viewmats is None else viewmats
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    for i in range(count):
        pixels = np.random.default_rng(i).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        save_image(root / "images" / f"im {i:03d}.png", pixels)
    poses = [(i, quaternion(viewmats[i, :3, :3]), viewmats[i, :3, 3].tolist()) for i in reversed(range(count))]
    write = _write_binary if suffix == ".bin" else _write_text
    write(folder, model, params, size, poses)
    return root


def _write_binary(folder: Path, model: str, params: tuple[float, ...], size: tuple[int, int], poses: list) -> None:
    camera = struct.pack("<QiiQQ", 1, 7, MODEL_IDS[model], *size) + struct.pack(f"<{len(params)}d", *params)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", len(poses))
    for i, quat, t in poses:
        images += struct.pack("<I7dI", i + 1, *quat, *t, 7) + f"im {i:03d}.png".encode() + b"\0"
        images += struct.pack("<Q", i % 3) + struct.pack("<ddq", 1.0, 2.0, -1) * (i % 3)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for i, (xyz, rgb, track) in enumerate(POINTS):
        points += struct.pack("<Q3d3Bd", i, *xyz, *rgb, 0.5) + struct.pack("<Q", track) + b"\1" * 8 * track
    (folder / "points3D.bin").write_bytes(points)


def _write_text(folder: Path, model: str, params: tuple[float, ...], size: tuple[int, int], poses: list) -> None:
    def line(*words: object) -> str:
        return " ".join(str(word) for word in words) + "\n"

    (folder / "cameras.txt").write_text("# Camera list\n" + line(7, model, *size, *params))
    images = "# Image list with two lines of data per image:\n"
    for i, quat, t in poses:
        images += line(i + 1, *quat, *t, 7, f"im {i:03d}.png") + ("1.0 2.0 -1" * (i % 2)) + "\n"
    (folder / "images.txt").write_text(images)
    points = "".join(line(i, *xyz, *rgb, 0.5, *([1, 2] * track)) for i, (xyz, rgb, track) in enumerate(POINTS))
    (folder / "points3D.txt").write_text("# 3D point list\n" + points)
