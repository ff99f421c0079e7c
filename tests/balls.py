"""Things made of opaque balls, seen by pinhole cameras with four rays a pixel, written as NeRF-synthetic."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gsopt.geometry.cameras import Cameras, intrinsics, look_at, opengl_from_viewmats
from gsopt.symmetry.mirror import Mirror

FIELD_OF_VIEW = 0.6


@dataclass(frozen=True)
class Ball:
    center: tuple[float, float, float]
    radius: float
    color: tuple[int, int, int] = (200, 120, 40)


def mirrored(balls: list[Ball], mirror: Mirror, *, repaint: bool = False) -> list[Ball]:
    """The balls and their mirror images, in the same colors or in inverted ones."""
    images = []
    for ball in balls:
        x, y, z = mirror.reflect(torch.tensor(ball.center)).tolist()
        r, g, b = ball.color
        images.append(Ball((x, y, z), ball.radius, (255 - r, 255 - g, 255 - b) if repaint else ball.color))
    return balls + images


def ring(count: int, elevation: float = 0.5, distance: float = 4.0, size: int = 96, turn: float = 0.3) -> Cameras:
    """Cameras around the z axis from `turn` off the x axis, by turns `elevation` radians above and below."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count) + turn
    up = torch.where(torch.arange(count) % 2 == 0, elevation, -elevation).double()
    eyes = distance * torch.stack([angle.cos() * up.cos(), angle.sin() * up.cos(), up.sin()], dim=1)
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    return Cameras(viewmats, intrinsics(FIELD_OF_VIEW, size, size).expand(count, 3, 3), size, size)


def write_balls(root: Path, balls: list[Ball], cameras: Cameras, held_out: Cameras | None = None) -> Path:
    """A dataset of these views; every ball shaded by the height of its normal."""
    for split, views in (("train", cameras), ("test", held_out)):
        if views is None:
            continue
        frames = []
        (root / split).mkdir(parents=True)
        for index, pose in enumerate(opengl_from_viewmats(views.viewmats).tolist()):
            Image.fromarray(picture(views[index], balls)).save(root / split / f"r_{index}.png")
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        document = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(document))
    return root


def picture(camera: Cameras, balls: list[Ball]) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    premultiplied = _cast(fine, balls).view(camera.height, 2, camera.width, 2, 4).mean((1, 3))
    alpha = premultiplied[..., 3:]
    color = torch.where(alpha > 0, premultiplied[..., :3] / alpha.clamp(min=1e-6), 0.0)
    return (torch.cat([color, 255 * alpha], dim=-1) + 0.5).clamp(0, 255).to(torch.uint8).numpy()


def _cast(camera: Cameras, balls: list[Ball]) -> torch.Tensor:
    """(H, W, 4) premultiplied color (0..255) and alpha (0 or 1)."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    K, R = camera.Ks[0], camera.viewmats[0, :3, :3]
    rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1).double() @ R
    rays = torch.nn.functional.normalize(rays, dim=-1)
    nearest = torch.full(rays.shape[:2], math.inf, dtype=torch.float64)
    shown = torch.zeros(*rays.shape[:2], 4, dtype=torch.float64)
    for ball in balls:
        center = torch.tensor(ball.center, dtype=torch.float64)
        origin = camera.centers[0] - center
        b = (rays * origin).sum(-1)
        root = b * b - origin.square().sum() + ball.radius**2
        depth = -b - root.clamp(min=0).sqrt()
        hit = (root > 0) & (depth < nearest)
        height = (origin + depth[..., None] * rays)[..., 2] / ball.radius
        painted = torch.tensor(ball.color, dtype=torch.float64) * (0.75 + 0.25 * height[..., None])
        shown = torch.where(hit[..., None], torch.cat([painted, torch.ones_like(depth)[..., None]], -1), shown)
        nearest = torch.where(hit, depth, nearest)
    return shown
