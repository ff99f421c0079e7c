"""Candidate cameras of guidance around the object, the word for each of their sides, and square input views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.scene import View
from gsopt.geometry.camera_paths import interpolated_path
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.focus import find_focus, up_direction
from gsopt.sds.priors.protocol import References

AZIMUTHS = 12
"""Candidates per ring."""
ELEVATION_STEP = math.radians(25)
"""Between the rings: one at the inputs' mean elevation, one below, one above."""
LOWEST, HIGHEST = math.radians(-20), math.radians(75)
JITTER = (math.radians(15), math.radians(8))
"""Largest shift of a candidate's azimuth and elevation when it is drawn."""
FORWARD_FACING = 24
"""Candidates between the inputs where these do not look at one subject."""
OVERHEAD = math.radians(60)
"""Elevation from which a view is one from the top."""
FRONT = math.radians(45)
"""Azimuth from the front up to which a view is a front view; the back is as wide."""


@dataclass(frozen=True)
class GuidanceCameras:
    """The candidate cameras, and the place of the object among the input cameras."""

    focus: Float[Tensor, "3"]
    up: Float[Tensor, "3"]
    ahead: Float[Tensor, "3"]
    """Horizontal unit vector from the focus to the front: to the camera that shows it."""
    distance: float
    """Distance of the guidance cameras to the focus, scene units."""
    K: Float[Tensor, "3 3"]
    size: int
    """Side of the guided renders, px."""
    candidates: Cameras
    angles: Float[Tensor, "C 2"] | None
    """Azimuth from the front and elevation of every candidate; a capture without an object in the middle has none."""

    def camera(self, index: int, generator: torch.Generator | None = None) -> Cameras:
        """A candidate; with a generator moved a little, so that no two steps look from the same place."""
        if generator is None or self.angles is None:
            return self.candidates[index]
        shift = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1) * torch.tensor(JITTER)
        azimuth, elevation = (self.angles[index] + shift).tolist()
        return self.placed(torch.tensor([[azimuth, min(max(elevation, LOWEST), HIGHEST)]], dtype=torch.float64))

    def placed(self, angles: Float[Tensor, "M 2"]) -> Cameras:
        """Cameras that look at the focus from these azimuths and elevations."""
        aside = torch.linalg.cross(self.up, self.ahead)
        azimuth, elevation = angles[:, :1], angles[:, 1:]
        level = azimuth.cos() * self.ahead + azimuth.sin() * aside
        eyes = self.focus + self.distance * (elevation.cos() * level + elevation.sin() * self.up)
        viewmats = look_at(eyes, self.focus, self.up)
        return Cameras(viewmats.float(), self.K.float().repeat(len(eyes), 1, 1), self.size, self.size)

    def side(self, camera: Cameras, front_known: bool) -> str:
        """top, front, side or back; "" where the front is not known."""
        azimuth, elevation = self._angles_of(camera)
        if elevation > OVERHEAD:
            return "top"
        if not front_known:
            return ""
        azimuth = abs(azimuth)
        return "front" if azimuth <= FRONT else "back" if azimuth >= math.pi - FRONT else "side"

    def _angles_of(self, camera: Cameras) -> tuple[float, float]:
        offset = camera.centers[0].double() - self.focus
        offset = offset / offset.norm().clamp_min(1e-12)
        aside = torch.linalg.cross(self.up, self.ahead)
        return math.atan2(float(offset @ aside), float(offset @ self.ahead)), math.asin(
            min(1.0, max(-1.0, float(offset @ self.up)))
        )


def guidance_cameras(inputs: Sequence[Cameras], extent: float, size: int, front: Cameras) -> GuidanceCameras:
    """Rings of cameras around the subject; between the inputs where their axes do not meet."""
    focus = find_focus(list(inputs), extent)
    same = Cameras.cat([square(camera, size) for camera in inputs])
    up = up_direction(same.viewmats)
    centers = same.centers.double() - focus.point.double()
    ahead = _level(front.centers[0].double() - focus.point.double(), up)
    lengths = centers.norm(dim=1)
    half = min(min(c.width / float(c.Ks[0, 0, 0]), c.height / float(c.Ks[0, 1, 1])) / 2 for c in inputs)
    K = intrinsics(2 * math.atan(half), size, size)
    cameras = GuidanceCameras(focus.point.double(), up, ahead, float(lengths.median()), K, size, same, None)
    if not focus.converging:
        return replace(cameras, candidates=interpolated_path(same, FORWARD_FACING).to(torch.float32))
    mean = float(torch.asin((centers @ up / lengths.clamp_min(1e-12)).clamp(-1, 1)).mean())
    angles = ring_angles(mean)
    return replace(cameras, candidates=cameras.placed(angles), angles=angles)


def ring_angles(mean_elevation: float) -> Float[Tensor, "C 2"]:
    """Three rings of AZIMUTHS cameras, each turned by a third of a gap against the one below."""
    rows = []
    for ring in (-1, 0, 1):
        elevation = min(max(mean_elevation + ring * ELEVATION_STEP, LOWEST), HIGHEST)
        rows += [(2 * math.pi * (i + ring / 3) / AZIMUTHS, elevation) for i in range(AZIMUTHS)]
    return torch.tensor(rows, dtype=torch.float64)


def draw_candidate(mean_u: Float[Tensor, "C"], least: float, generator: torch.Generator) -> int | None:
    """A candidate, drawn in proportion to its mean uncertainty; none when all lie below `least`."""
    chances = torch.where(mean_u >= least, mean_u.double(), 0.0)
    if float(chances.sum()) <= 0:
        return None
    return int(torch.multinomial(chances, 1, generator=generator))


def square(camera: Cameras, size: int) -> Cameras:
    """The middle square of a camera's image, `size` px."""
    side = min(camera.width, camera.height)
    K = camera.Ks.clone()
    K[:, 0, 2] -= (camera.width - side) // 2
    K[:, 1, 2] -= (camera.height - side) // 2
    return replace(camera, Ks=K, width=side, height=side).resized(size, size).to(torch.float32)


def square_views(views: Sequence[View], size: int, background: Float[Tensor, "3"]) -> References:
    """The middle squares of input views, on the background."""
    pictures = [_square_picture(view.pixels().permute(2, 0, 1).float() / 255, size) for view in views]
    alphas = torch.stack([p[3:] if len(p) == 4 else torch.ones_like(p[:1]) for p in pictures])
    colors = torch.stack([p[:3] for p in pictures]) + (1 - alphas) * background.view(1, 3, 1, 1)
    return References(colors.clamp(0, 1), alphas, Cameras.cat([square(view.camera, size) for view in views]))


def _square_picture(planes: Float[Tensor, "C H W"], size: int) -> Float[Tensor, "C S S"]:
    """Cut, premultiplied and resampled with an antialiasing filter."""
    height, width = planes.shape[1:]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    planes = planes[:, top : top + side, left : left + side]
    if len(planes) == 4:
        planes = torch.cat([planes[:3] * planes[3:], planes[3:]])
    return torch.nn.functional.interpolate(planes[None], (size, size), mode="bilinear", antialias=True)[0].clamp(0, 1)


def nearest(references: References, camera: Cameras, count: int) -> References | None:
    """The `count` reference views whose directions are closest to that of a camera."""
    if count == 0 or len(references.cameras) == 0:
        return None
    cosine = references.cameras.forwards @ camera.forwards[0].to(references.cameras.forwards)
    rows = torch.sort(cosine, descending=True, stable=True).indices[:count]
    cameras = references.cameras
    chosen = replace(cameras, viewmats=cameras.viewmats[rows], Ks=cameras.Ks[rows])
    depths = None if references.depths is None else references.depths[rows]
    return References(references.images[rows], references.alphas[rows], chosen, depths)


def _level(direction: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The horizontal part, as a unit vector; any horizontal one for a direction straight up."""
    flat = direction - (direction @ up) * up
    if float(flat.norm()) < 1e-6 * max(float(direction.norm()), 1e-12):
        flat = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())])
    return flat / flat.norm()
