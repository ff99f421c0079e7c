"""A scene of known shape: an ellipsoid painted by direction, seen by pinhole cameras, written as NeRF-synthetic."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats

FIELD_OF_VIEW = 0.7
RED, BLUE = (230, 30, 20), (20, 40, 220)


def spread_cameras(count: int, distance: float = 4.0, size: int = 64) -> Cameras:
    """Cameras on a sphere (Fibonacci) around the origin, looking at it."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    angle = i * math.pi * (3 - math.sqrt(5))
    eyes = distance * torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], dim=1)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    return Cameras(viewmats, intrinsics(FIELD_OF_VIEW, size, size).expand(count, 3, 3), size, size)


def ellipsoid_scene(
    root: Path, cameras: Cameras, center: tuple[float, float, float], radii: tuple[float, float, float]
) -> Path:
    """Opaque inside, transparent outside; the half with x > center is red, the other blue."""
    root.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, pose in enumerate(opengl_from_viewmats(cameras.viewmats).tolist()):
        Image.fromarray(_render(cameras[index], center, radii)).save(root / f"r_{index}.png")
        frames.append({"file_path": f"./r_{index}", "transform_matrix": pose})
    document = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
    (root / "transforms_train.json").write_text(json.dumps(document))
    return root


def _render(camera: Cameras, center: tuple[float, float, float], radii: tuple[float, float, float]) -> np.ndarray:
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    K, R = camera.Ks[0], camera.viewmats[0, :3, :3]
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1).double() @ R
    scale = torch.tensor(radii, dtype=torch.float64)
    origin = (camera.centers[0] - torch.tensor(center, dtype=torch.float64)) / scale
    rays = rays / scale
    # |origin + s ray|² = 1
    a, b, c = rays.square().sum(-1), (rays * origin).sum(-1), origin.square().sum() - 1
    root = b * b - a * c
    nearest = (-b - root.clamp(min=0).sqrt()) / a
    right = origin[0] + nearest * rays[..., 0] > 0
    pixels = torch.where(right[..., None], torch.tensor(RED), torch.tensor(BLUE))
    alpha = (root > 0)[..., None] * 255
    return torch.cat([pixels * (alpha > 0), alpha], dim=-1).to(torch.uint8).numpy()
