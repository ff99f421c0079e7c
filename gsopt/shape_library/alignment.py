"""Shapes moved, turned and stretched until their silhouettes lie on that of the photo.

A world point x meets a shape at p, in its box around 0:

    (1)  p = M diag(e^-h, e^-h, e^-v) R(a)ᵀ Uᵀ (x - c - size (r right + u up)) / size,

U: upright frame of the photo, a: turn about the vertical, h and v: logarithms of the level and the vertical scale, r
and u: shift in the image, M: mirror or not. Depth follows the level scale: one photo cannot tell it, the shape can. A
silhouette is the largest soft occupancy on each ray, so that (1) is found by gradient descent on

    (2)  1 - IoU(silhouette, alpha) + STRETCH_COST (v - h)² + SCALE_COST (h - h0)².
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.shape_library.outline import Outline
from gsopt.shape_library.poses import Poses, turn_matrix

STRETCH_COST, SCALE_COST = 0.15, 0.05
RATE = 0.07
"""Rate of Adam (Kingma & Ba 2015) at first; it falls to 0."""
ADAM = 0.9, 0.999
"""Its decay of the mean slope and of the mean square. torch's own imports its compiler, 1.4 CPU seconds."""
MAX_STRETCH = 0.3
"""Largest |v - h| / 2 of the first guess."""
MAX_LOG_SCALE = 1.5
BOX_ROUNDS = 6
CHUNK = 8
"""Shapes that are aligned at once: bounds memory."""


@dataclass(frozen=True)
class Alignments:
    """Aligned shapes, one a row."""

    poses: Poses
    parameters: Float[Tensor, "B 5"]
    """a, h, v, r, u of (1)."""
    agreement: Float[Tensor, "B"]
    """1 - (2)."""

    def __getitem__(self, rows: Tensor) -> Alignments:
        return Alignments(self.poses[rows], self.parameters[rows], self.agreement[rows])


def soft(occupied: Bool[Tensor, "B s s s"]) -> Float[Tensor, "B 1 s s s"]:
    """Occupancy, half of it averaged over neighbors: a gradient that reaches farther than a voxel."""
    full = occupied.float()[:, None]
    return (full + torch.nn.functional.avg_pool3d(full, 3, stride=1, padding=1)) / 2


@torch.no_grad()
def boxed(outline: Outline, poses: Poses, points: Float[Tensor, "B P 3"]) -> Alignments:
    """A first guess: scales and shifts with which the points' box is the silhouette's."""
    mirrored = torch.stack([points[..., 0] * poses.mirror[:, None], points[..., 1], points[..., 2]], dim=-1)
    turned = mirrored @ turn_matrix(poses.azimuth).mT
    log_scale, shift = torch.zeros(len(points), 2), torch.zeros(len(points), 2)
    middle = (outline.box[:2] + outline.box[2:]) / 2
    pixel = outline.depth / outline.size / outline.camera.Ks[0].diagonal()[:2]
    for _ in range(BOX_ROUNDS):
        stretched = turned * log_scale[:, [0, 0, 1]].exp()[:, None]
        pixels = outline.project((_moved(outline, shift)[:, None] + stretched @ outline.upright.T) * outline.size)
        low, high = pixels.amin(dim=1), pixels.amax(dim=1)
        log_scale = log_scale + (outline.sides / (high - low).clamp_min(1e-3)).log() * torch.tensor([1.0, 1.3])
        mean, stretch = log_scale.mean(1, keepdim=True), (log_scale[:, 1:] - log_scale[:, :1]) / 2
        stretch = stretch.clamp(-MAX_STRETCH, MAX_STRETCH)
        log_scale = torch.cat([mean - stretch, mean + stretch], dim=1).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
        shift = shift + (middle - (low + high) / 2) * pixel * torch.tensor([1.0, -1.0])
    parameters = torch.cat([poses.azimuth[:, None], log_scale, shift], dim=1)
    return Alignments(poses, parameters, torch.zeros(len(points)))


def _moved(outline: Outline, shift: Float[Tensor, "B 2"]) -> Float[Tensor, "B 3"]:
    """Middles of shifted shapes, in units of the object's size."""
    right, down = outline.camera.viewmats[0, 0, :3], outline.camera.viewmats[0, 1, :3]
    return outline.middle / outline.size + shift[:, :1] * right - shift[:, 1:] * down


def occupancy(
    outline: Outline,
    volumes: Float[Tensor, "B 1 s s s"],
    sizes: Float[Tensor, "B 3"],
    mirror: Float[Tensor, "B"],
    parameters: Float[Tensor, "B 5"],
    points: Float[Tensor, "*B M 3"],
) -> Float[Tensor, "B M"]:
    """Soft occupancy of aligned shapes at world points, the same or own ones for each, by (1)."""
    offset = points / outline.size - _moved(outline, parameters[:, 3:])[:, None]
    turned = offset @ (outline.upright @ turn_matrix(parameters[:, 0]))
    place = turned * (-parameters[:, [1, 1, 2]]).exp()[:, None]
    place = torch.cat([place[..., :1] * mirror[:, None, None], place[..., 1:]], dim=-1)
    grid = (2 * place / sizes[:, None]).flip(-1)[:, :, None, None]
    return torch.nn.functional.grid_sample(volumes, grid, align_corners=False)[:, 0, :, 0, 0]


@torch.no_grad()
def aligned(
    outline: Outline,
    start: Alignments,
    volumes: Float[Tensor, "B 1 s s s"],
    sizes: Float[Tensor, "B 3"],
    raster: tuple[int, int],
    steps: int,
) -> Alignments:
    """The best of (2) that `steps` steps of Adam pass. `raster`: pixels along a side, and points on a ray."""
    points, alpha = outline.rays(*raster)
    rays, alpha = points.flatten(0, 1), alpha.flatten()
    parts = []
    for rows in torch.arange(len(start.parameters)).split(CHUNK):
        parts.append(_aligned(outline, start[rows], volumes[rows], sizes[rows], rays, alpha, steps))
    parameters, agreement = (torch.cat([part[i] for part in parts]) for i in range(2))
    return Alignments(start.poses, parameters, agreement)


def _aligned(
    outline: Outline,
    start: Alignments,
    volumes: Float[Tensor, "B 1 s s s"],
    sizes: Float[Tensor, "B 3"],
    rays: Float[Tensor, "P D 3"],
    alpha: Float[Tensor, "P"],
    steps: int,
) -> tuple[Tensor, Tensor]:
    best, best_agreement = start.parameters, torch.full((len(sizes),), -1.0)
    parameters, mean, square = best, torch.zeros_like(best), torch.zeros_like(best)
    for step in range(steps + 1):
        agreement, slope = agreement_and_slope(outline, start, volumes, sizes, parameters, rays, alpha)
        better = agreement > best_agreement
        best_agreement = torch.where(better, agreement, best_agreement)
        best = torch.where(better[:, None], parameters, best)
        mean, square = torch.lerp(slope, mean, ADAM[0]), torch.lerp(slope.square(), square, ADAM[1])
        unbiased = [moment / (1 - decay ** (step + 1)) for moment, decay in zip((mean, square), ADAM, strict=True)]
        parameters = parameters + RATE * (1 - step / max(steps, 1)) * unbiased[0] / (unbiased[1].sqrt() + 1e-8)
    return best, best_agreement


def agreement_and_slope(
    outline: Outline,
    start: Alignments,
    volumes: Float[Tensor, "B 1 s s s"],
    sizes: Float[Tensor, "B 3"],
    parameters: Float[Tensor, "B 5"],
    rays: Float[Tensor, "P D 3"],
    alpha: Float[Tensor, "P"],
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B 5"]]:
    """1 - (2), and its gradient: of a ray only the point with the largest occupancy has one."""
    mirror = start.poses.mirror
    filled = occupancy(outline, volumes, sizes, mirror, parameters, rays.flatten(0, 1))
    drawn_at = rays[torch.arange(len(rays)), filled.view(len(sizes), *rays.shape[:2]).argmax(dim=2)]
    with torch.enable_grad():
        moved = parameters.detach().requires_grad_(True)
        drawn = occupancy(outline, volumes, sizes, mirror, moved, drawn_at)
        shared = (drawn * alpha).sum(1)
        union = (drawn + alpha).sum(1) - shared
        stretch, growth = moved[:, 2] - moved[:, 1], moved[:, 1] - start.parameters[:, 1]
        agreement = shared / union - STRETCH_COST * stretch**2 - SCALE_COST * growth**2
        (slope,) = torch.autograd.grad(agreement.sum(), moved)
    return agreement.detach(), slope
