"""Where the cameras of a synthetic dataset stand, and how its json says so. numpy only, no bpy.

Poses are world_from_cam in the axes of NeRF-synthetic and Blender (x right, y up, looking along -z), world z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from gsopt import check
from gsopt.errors import InputError, UsageError

if TYPE_CHECKING:
    from jaxtyping import Float

Layout = Literal["hemisphere", "sphere", "orbit"]
ELEVATIONS: dict[str, tuple[float, float]] = {"hemisphere": (0.0, 80.0), "sphere": (-90.0, 90.0), "orbit": (20.0, 20.0)}
"""Lowest and highest elevation of a layout when none is given, degrees."""
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class RenderSettings:
    """What to photograph, from where and how finely."""

    views: int = 50
    """Input views."""
    test_views: int = 20
    """Held-out views, between the input views."""
    resolution: int = 256
    """Width and height, px."""
    samples: int = 32
    """Light paths per pixel."""
    fov: float = 40.0
    """Horizontal field of view, degrees."""
    radius: float | None = None
    """Distance of the cameras from the origin, units of the unit sphere; by default the sphere just fits the frame."""
    layout: Layout = "hemisphere"
    """hemisphere and sphere: Fibonacci points between two elevations; orbit: one turn, rising from one to the other."""
    elevations: tuple[float, float] | None = None
    """Lowest and highest elevation, degrees; the layout's own when not given (`ELEVATIONS`)."""
    threads: int = 0
    """Threads of Cycles; 0 uses every core. The images do not depend on it."""

    def __post_init__(self) -> None:
        check.within("--views", self.views, 1, 2000, "100 is what NeRF-synthetic has.")
        check.within("--test-views", self.test_views, 0, 2000, "0 renders no held-out views.")
        check.within("--resolution", self.resolution, 8, 8192, "Give the side of the square image in pixels.")
        check.within("--samples", self.samples, 1, 65_536, "16 is noisy but usable, 64 is clean.")
        check.within("--fov", self.fov, 1.0, 150.0, "Give the horizontal field of view in degrees.")
        check.one_of("--layout", self.layout, get_args(Layout))
        check.within("--threads", self.threads, 0, 1024, "0 uses every core.")
        low, high = self.elevation_range
        if not -90.0 <= low <= high <= 90.0:
            raise UsageError(
                f"`--elevations` must be LOW <= HIGH within -90 to 90 degrees, got {low} {high}. Try -15 65."
            )
        if self.radius is not None:
            check.within("--radius", self.radius, 1.01, 1e4, "The object fills the unit sphere: stay outside of it.")

    @property
    def elevation_range(self) -> tuple[float, float]:
        """Lowest and highest elevation, degrees."""
        return self.elevations or ELEVATIONS[self.layout]

    @property
    def fov_x(self) -> float:
        """Horizontal field of view, radians."""
        return math.radians(self.fov)

    @property
    def distance(self) -> float:
        """Of the cameras from the origin: `radius`, or where the unit sphere's outline spans 96 % of the frame.

        The outline of the unit sphere seen from distance d has the tangent 1 / sqrt(d² - 1) to the optical axis.
        """
        if self.radius is not None:
            return self.radius
        return math.sqrt(1.0 + 1.0 / (0.96 * math.tan(0.5 * self.fov_x)) ** 2)


def band_directions(count: int, heights: tuple[float, float], turn: float, phase: float) -> Float[np.ndarray, "N 3"]:
    """Unit vectors on a spiral: range of z in `heights`, azimuth step in `turn`, first azimuth in `phase` (radians).

    Equal steps in z are equal areas of the sphere (Archimedes); with the golden angle this is the Fibonacci sphere.
    """
    low, high = heights
    z = high - (high - low) * (np.arange(count) + 0.5) / max(count, 1)
    ring = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    azimuth = phase + turn * np.arange(count)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def camera_directions(settings: RenderSettings, seed: int) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "M 3"]]:
    """Directions from the origin to the input and the held-out cameras; `seed` turns them all about z.

    Held-out cameras keep within the heights of the input cameras, so they interpolate; of 90 turns about z they take
    the one that keeps them farthest away from the input cameras.
    """
    low, high = (math.sin(math.radians(e)) for e in settings.elevation_range)
    orbit = settings.layout == "orbit"
    start = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi)

    def spiral(count: int, heights: tuple[float, float], phase: float) -> Float[np.ndarray, "K 3"]:
        return band_directions(count, heights, 2.0 * math.pi / max(count, 1) if orbit else GOLDEN_ANGLE, phase)

    train = spiral(settings.views, (low, high), start)
    heights = (float(train[:, 2].min()), float(train[:, 2].max()))
    phases = start + np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    nearest = [(spiral(settings.test_views, heights, p) @ train.T).max(initial=-1.0) for p in phases]
    return train, spiral(settings.test_views, heights, float(phases[int(np.argmin(nearest))]))


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
    """Image paths relative to the dataset, without the extension, which readers of NeRF-synthetic append."""
    digits = max(3, len(str(count - 1)))
    return [f"./{split}/r_{i:0{digits}d}" for i in range(count)]


def transforms(split: str, poses: Float[np.ndarray, "N 4 4"], settings: RenderSettings) -> dict[str, Any]:
    """The content of transforms_{split}.json: NeRF-synthetic's keys plus explicit intrinsics in px."""
    size = settings.resolution
    focal = 0.5 * size / math.tan(0.5 * settings.fov_x)
    names = frame_names(split, len(poses))
    return {
        "camera_angle_x": settings.fov_x,
        "w": size,
        "h": size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": 0.5 * size,
        "cy": 0.5 * size,
        "frames": [{"file_path": n, "transform_matrix": p.tolist()} for n, p in zip(names, poses, strict=True)],
    }


def normalization(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "4 4"]:
    """The similarity that takes the middle of the bounding box to the origin and the farthest vertex to distance 1.

    InputError when a coordinate is not finite or the mesh has no extent.
    """
    if not np.isfinite(vertices).all():
        bad = int(np.nonzero(~np.isfinite(vertices).all(axis=1))[0][0])
        raise InputError(
            f"The mesh must have finite coordinates, got {vertices[bad].tolist()}. Repair or export it again."
        )
    center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    extent = float(np.linalg.norm(vertices - center, axis=1).max())
    if not 1e-12 < extent < 1e12:
        raise InputError(f"The mesh must have an extent, got a radius of {extent:g}. Check the export's units.")
    matrix = np.eye(4) / extent
    matrix[:3, 3] = -center / extent
    matrix[3, 3] = 1.0
    return matrix
