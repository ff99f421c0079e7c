"""Poses of few photos checked by what did NOT match: photos taken side by side must show the same things.

Matches say where photos agree. A thing that looks alike from several sides (a lantern with six of them, a room with the
same poster twice) matches itself turned, and poses follow that fit all of it. The surroundings tell: a point that one
photo shows lies in front of another one too, which by these poses was taken from nearly the same side, and there
something else is seen. The patches of surface around the point are compared, by the correlation of their gray values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.resample import sample
from gsopt.raster.threads import one_torch_thread

MAX_SIDE = 800
"""Longer side of the photos that are compared, px."""
MAX_POINTS = 3000
"""Points that are looked at, evenly spread over all."""
NEIGHBORS = 12
"""Points around one that span the plane of its patch."""
REACH, SAMPLES = 8.0, 11
"""Half the width of a patch, px, and its samples along each side."""
LEAST_CONTRAST = 3.0
"""Standard deviation of a patch's gray values, of 255, below which it shows nothing."""
SIDE_BY_SIDE = 25.0
"""Degrees up to which two photos see a point from the same side."""
MAX_ZOOM = 1.6
"""Ratio of their distances to it up to which they show it in the same detail."""
AROUND, REACH_AROUND, BEHIND = 3, 80.0, 0.9
"""Points around one, at most so many px away, that hide it where their depth is less than this share of its own."""
LEAST_PATCHES = 30
"""Patches by which two photos are compared."""
ALIKE = 0.25
"""Median correlation of the patches below which a photo contradicts another one."""
LEAST_CONTRADICTED, MOST_CONTRADICTED = 2, 1 / 6
"""Contradictions from which on poses are wrong, and their share. Right poses: 6 of 52 (a ball that hides much), 1 of 16
and less (a shiny head, a fox, rendered tables); wrong ones: 2 of 8, 8 of 24, 18 of 29 (decision 0025)."""


@dataclass(frozen=True)
class Agreement:
    """Pairs of photos that were compared, in each direction, and those of them that contradict each other."""

    compared: int
    contradicted: int

    @property
    def contradicts(self) -> bool:
        """True where poses must be wrong."""
        return self.contradicted >= max(LEAST_CONTRADICTED, MOST_CONTRADICTED * self.compared)


@dataclass(frozen=True)
class _Photo:
    """A placed photo: its gray values, and which of the points its features see."""

    pixels: Float[torch.Tensor, "1 H W"]
    camera: Any
    scale: float
    """Its pixels over those of the camera."""
    cam_from_world: Float[np.ndarray, "3 4"]
    sees: Bool[np.ndarray, "P"]

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    def project(self, xyz: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
        """Positions, px, and which of them lie a patch's width inside the picture."""
        local = xyz @ self.cam_from_world[:, :3].T + self.cam_from_world[:, 3]
        ahead = local[:, 2] > 0
        xy = np.full((len(xyz), 2), -1e6)
        xy[ahead] = self.scale * self.camera.img_from_cam(local[ahead])
        xy[~np.isfinite(xy)] = -1e6
        height, width = self.pixels.shape[1:]
        return xy, np.all((xy >= REACH) & (xy <= np.array([width, height]) - REACH), axis=1)

    def gray(self, xyz: Float[np.ndarray, "N S 3"]) -> Float[np.ndarray, "N S"]:
        """Gray values at points."""
        xy = torch.from_numpy(self.project(xyz.reshape(-1, 3))[0]).float()
        return sample(self.pixels, xy[:, 0], xy[:, 1]).double().numpy().reshape(xyz.shape[:2])


def agreement(reconstruction: Any, photos: Path) -> Agreement:
    """Compares all pairs of placed photos that see enough points from the same side."""
    with one_torch_thread():
        medians = [median for _, _, median in correlations(reconstruction, photos)]
    return Agreement(len(medians), sum(median < ALIKE for median in medians))


def correlations(reconstruction: Any, photos: Path) -> Iterator[tuple[str, str, float]]:
    """Two photos, and the median correlation of the patches that features of the first one see and those of the second
    one do not, though they lie in front of it."""
    numbers = sorted(reconstruction.point3D_ids())
    numbers = numbers[:: max(1, -(-len(numbers) // MAX_POINTS))]
    xyz = np.array([reconstruction.point3D(number).xyz for number in numbers]).reshape(-1, 3)
    if len(xyz) < LEAST_PATCHES:
        return
    placed = _placed(reconstruction, photos, numbers)
    normals = _normals(xyz)
    for (name, one), (other_name, other) in itertools.permutations(placed.items(), 2):
        rows = np.flatnonzero(_shown_alike(one, other, xyz) & ~other.sees)
        rows = rows[~_hidden(other, xyz[rows], xyz[other.sees])]
        if len(rows) < LEAST_PATCHES:
            continue
        found = _correlation(one, other, xyz[rows], normals[rows])
        found = found[np.isfinite(found)]
        if len(found) >= LEAST_PATCHES:
            yield name, other_name, float(np.median(found))


def _placed(reconstruction: Any, photos: Path, numbers: list[int]) -> dict[str, _Photo]:
    tracks = [{element.image_id for element in reconstruction.point3D(n).track.elements} for n in numbers]
    placed: dict[str, _Photo] = {}
    for image_id in sorted(reconstruction.reg_image_ids()):
        image = reconstruction.image(image_id)
        camera = reconstruction.camera(image.camera_id)
        pixels = _gray(photos / image.name)
        placed[image.name] = _Photo(
            pixels,
            camera,
            pixels.shape[2] / camera.width,
            image.cam_from_world().matrix(),
            np.array([image_id in track for track in tracks]),
        )
    return placed


def _gray(path: Path) -> Float[torch.Tensor, "1 H W"]:
    with Image.open(path, formats=IMAGE_FORMATS) as image:
        image.draft("L", (MAX_SIDE, MAX_SIDE))
        gray = image.convert("L")
    gray.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
    return torch.from_numpy(np.array(gray, dtype=np.float32))[None]


def _normals(xyz: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """The direction in which a point and those around it spread least."""
    points = torch.from_numpy(xyz)
    around = points[torch.cdist(points, points).topk(NEIGHBORS, largest=False).indices]
    spread = torch.linalg.svd(around - around.mean(dim=1, keepdim=True), full_matrices=False).Vh
    return spread[:, 2].numpy()


def _shown_alike(one: _Photo, other: _Photo, xyz: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    """Points that features of one photo see, and that lie before the other one on the same side and as near."""
    to_one, to_other = xyz - one.center, xyz - other.center
    far, far_other = np.linalg.norm(to_one, axis=1), np.linalg.norm(to_other, axis=1)
    near = (to_one * to_other).sum(axis=1) > np.cos(np.radians(SIDE_BY_SIDE)) * far * far_other
    alike = np.maximum(far, far_other) < MAX_ZOOM * np.minimum(far, far_other)
    return one.sees & near & alike & one.project(xyz)[1] & other.project(xyz)[1]


def _hidden(photo: _Photo, xyz: Float[np.ndarray, "R 3"], seen: Float[np.ndarray, "S 3"]) -> Bool[np.ndarray, "R"]:
    """Points that lie behind what the photo's features see around them."""
    if len(seen) < AROUND or len(xyz) == 0:
        return np.zeros(len(xyz), dtype=bool)
    pixels, seen_pixels = (torch.from_numpy(photo.project(points)[0]) for points in (xyz, seen))
    near = torch.cdist(pixels, seen_pixels).topk(AROUND, largest=False)
    depths, seen_depths = (points @ photo.cam_from_world[2, :3] + photo.cam_from_world[2, 3] for points in (xyz, seen))
    before = np.median(seen_depths[near.indices.numpy()], axis=1) < BEHIND * depths
    return before & (near.values[:, -1].numpy() < REACH_AROUND)


def _correlation(
    one: _Photo, other: _Photo, xyz: Float[np.ndarray, "R 3"], normals: Float[np.ndarray, "R 3"]
) -> Float[np.ndarray, "R"]:
    """Correlation of the patches at points, in the plane of the points around them or in one that faces the first
    photo, whichever is better; NaN where a patch shows nothing."""
    axis = np.broadcast_to(one.cam_from_world[2, :3], xyz.shape)
    return np.fmax(*(_of_patches(one, other, xyz, each) for each in (normals, axis)))


def _of_patches(
    one: _Photo, other: _Photo, xyz: Float[np.ndarray, "R 3"], normals: Float[np.ndarray, "R 3"]
) -> Float[np.ndarray, "R"]:
    depths = (xyz - one.center) @ one.cam_from_world[2, :3]
    reach = depths * REACH / (one.scale * one.camera.mean_focal_length())
    across = np.cross(normals, one.cam_from_world[1, :3])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    u, v = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, SAMPLES)] * 2))
    offsets = u[:, None] * across[:, None] + v[:, None] * along[:, None]
    patches = xyz[:, None] + reach[:, None, None] * offsets
    values = [photo.gray(patches) for photo in (one, other)]
    centered = [gray - gray.mean(axis=1, keepdims=True) for gray in values]
    contrast = [np.sqrt(np.square(gray).mean(axis=1)) for gray in centered]
    found = (centered[0] * centered[1]).mean(axis=1) / np.maximum(contrast[0] * contrast[1], 1e-12)
    found[contrast[0] < LEAST_CONTRAST] = np.nan
    return found
