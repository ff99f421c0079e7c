"""Cameras of the views of an object. numpy only.

Poses are world_from_cam in the axes of NeRF-synthetic and Blender (x right, y up, looking along -z), world z up.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsopt.errors import InputError
from synth.settings import SPLITS, Settings

if TYPE_CHECKING:
    from jaxtyping import Float

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
SPIRAL_TURNS = 3.0
MAX_FILE_BYTES = 64 << 20


@dataclass(frozen=True)
class Shot:
    """One view: its name is that of its files, without the extension."""

    name: str
    split: str
    world_from_cam: Float[np.ndarray, "4 4"]
    focal: float
    """px; pixels are square."""
    center: tuple[float, float]
    """Principal point, px; the center of pixel (i, j) is (i + 0.5, j + 0.5)."""

    @property
    def eye(self) -> Float[np.ndarray, "3"]:
        return self.world_from_cam[:3, 3]


def shots(settings: Settings, seed: int) -> list[Shot]:
    """All views of one object, split by split."""
    if settings.layout == "file":
        return shots_of_file(Path(str(settings.camera_file)), settings)
    directions = camera_directions(settings, seed)
    rng = np.random.default_rng([seed, 1])
    found = []
    for split in SPLITS:
        poses = look_at_origin(settings.distance * directions[split])
        for name, pose in zip(frame_names(split, len(poses)), poses, strict=True):
            zoom, right, down = settings.lens_jitter * rng.uniform(-1.0, 1.0, 3)
            found.append(shot(settings, name, split, pose, 1.0 + zoom, (0.25 * right, 0.25 * down)))
    return found


def shot(
    settings: Settings,
    name: str,
    split: str,
    pose: Float[np.ndarray, "4 4"],
    zoom: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Shot:
    """A view whose principal point lies `shift` (right, down) off the middle, in short sides of the image."""
    width, height = settings.resolution
    right, down = (min(width, height) * s for s in shift)
    return Shot(name, split, pose, settings.focal * zoom, (0.5 * width + right, 0.5 * height + down))


def camera_directions(settings: Settings, seed: int) -> dict[str, Float[np.ndarray, "N 3"]]:
    """Unit vectors from the origin to the cameras of each split; `seed` turns them all about z.

    Held-out cameras keep within the heights of the input cameras, so they interpolate; of 90 turns about z they take
    the one that keeps them farthest away from all cameras placed before.
    """
    low, high = (math.sin(math.radians(e)) for e in settings.elevation_range)
    rng = np.random.default_rng(seed)
    start = rng.uniform(0.0, 2.0 * math.pi)
    counts = dict(zip(SPLITS, (settings.views, settings.test_views, settings.val_views), strict=True))
    if settings.layout == "random":
        return {split: random_directions(count, (low, high), rng) for split, count in counts.items()}
    turns = {"orbit": 1.0, "spiral": SPIRAL_TURNS}.get(settings.layout)

    def spiral(count: int, heights: tuple[float, float], phase: float) -> Float[np.ndarray, "K 3"]:
        step = GOLDEN_ANGLE if turns is None else turns * 2.0 * math.pi / max(count, 1)
        return band_directions(count, heights, step, phase)

    found = {"train": spiral(counts["train"], (low, high), start)}
    heights = (float(found["train"][:, 2].min()), float(found["train"][:, 2].max()))
    phases = start + np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    for split in SPLITS[1:]:
        placed = np.concatenate(list(found.values()))
        nearest = [(spiral(counts[split], heights, p) @ placed.T).max(initial=-1.0) for p in phases]
        found[split] = spiral(counts[split], heights, float(phases[int(np.argmin(nearest))]))
    return found


def band_directions(count: int, heights: tuple[float, float], turn: float, phase: float) -> Float[np.ndarray, "N 3"]:
    """Unit vectors on a spiral: range of z in `heights`, azimuth step in `turn`, first azimuth in `phase` (radians).

    Equal steps in z are equal areas of the sphere (Archimedes); with the golden angle this is the Fibonacci sphere.
    """
    low, high = heights
    z = high - (high - low) * (np.arange(count) + 0.5) / max(count, 1)
    return from_cylinder(z, phase + turn * np.arange(count))


def random_directions(count: int, heights: tuple[float, float], rng: np.random.Generator) -> Float[np.ndarray, "N 3"]:
    """Unit vectors uniform by area between two heights."""
    return from_cylinder(rng.uniform(*heights, count), rng.uniform(0.0, 2.0 * math.pi, count))


def from_cylinder(z: Float[np.ndarray, "N"], azimuth: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
    ring = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def look_at_origin(eyes: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4 4"]:
    """world_from_cam of cameras at `eyes` that look at the origin with z up; at the poles +y is up in the image."""
    back = eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = np.where(np.linalg.norm(right, axis=1, keepdims=True) < 1e-9, [1.0, 0.0, 0.0], right)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(eyes), 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(back, right), back], axis=2)
    poses[:, :3, 3] = eyes
    return poses


def frame_names(split: str, count: int) -> list[str]:
    """train_000, train_001, ...: they sort as they are numbered."""
    digits = max(3, len(str(count - 1)))
    return [f"{split}_{i:0{digits}d}" for i in range(count)]


def shots_of_file(path: Path, settings: Settings) -> list[Shot]:
    """The poses of a transforms.json, in the world of the normalized object; lens and size are those of `settings`.

    InputError for a file without rigid poses.
    """
    remedy = "Give a transforms.json with `frames`, each with a rigid `transform_matrix`."
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError(f"it is larger than {MAX_FILE_BYTES} bytes")
        frames = json.loads(path.read_text(encoding="utf-8-sig"))["frames"]
        poses: list[tuple[str, Float[np.ndarray, "4 4"]]] = [
            (frame.get("split", "train"), np.array(frame["transform_matrix"], np.float64)) for frame in frames
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"Cannot take cameras from {path}: {error or type(error).__name__}. {remedy}") from None
    for number, (split, pose) in enumerate(poses):
        if split not in SPLITS or not is_rigid(pose):
            raise InputError(f"frames[{number}] of {path} is no camera of {', '.join(SPLITS)}. {remedy}")
    if not any(split == "train" for split, _ in poses):
        raise InputError(f"{path} has no camera of the split train. {remedy}")
    chosen = {split: [pose for s, pose in poses if s == split] for split in SPLITS}
    return [
        shot(settings, name, split, pose)
        for split in SPLITS
        for name, pose in zip(frame_names(split, len(chosen[split])), chosen[split], strict=True)
    ]


def is_rigid(pose: Any) -> bool:
    """True for a rotation (no mirror, no scale) and a translation, finite."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], (0, 0, 0, 1)):
        return False
    R = pose[:3, :3]
    return bool(np.allclose(R.T @ R, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0)
