"""The scenes that the kernels are timed on: splats on the surfaces of a torus, a sphere and a disc of ground.

They resemble a trained scene: flat along the normal, as wide as the distance to their neighbors, a few much wider, with
every band of the spherical harmonics, in Morton order, and all in view.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import quats
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.morton import morton_order
from gsopt.init.neighbors import mean_neighbor_distance

TORUS_RADIUS, TUBE_RADIUS, SPHERE_RADIUS, GROUND_RADIUS = 1.0, 0.35, 0.5, 1.45
FLATNESS = 0.1
"""Thickness along the normal over width."""
WIDE_SHARE, WIDE_FACTOR = 0.03, 3.0
OPACITY_RANGE = (0.1, 0.99)
FOV = 0.595
EYE = (2.6, -3.0, 2.4)


def surface_scene(count: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Cameras]:
    """`count` splats of SH degree 3 and one camera that sees them all; equal arguments give equal scenes."""
    rng = torch.Generator().manual_seed(seed)
    points, normals = surface_points(count, rng)
    order = morton_order(points)
    points, normals = points[order], normals[order]
    is_wide = torch.rand(count, generator=rng) < WIDE_SHARE
    widths = mean_neighbor_distance(points) * torch.where(is_wide, WIDE_FACTOR, 1.0)
    low, high = OPACITY_RANGE
    opacities = low + (high - low) * torch.rand(count, generator=rng).sqrt()  # Beta(2, 1): most are fairly opaque
    gaussians = Gaussians(
        means=points,
        quats=quats.from_rotation_matrices(rotations_from_normals(normals)),
        log_scales=(widths[:, None] * torch.tensor([1.0, 1.0, FLATNESS])).log(),
        logit_opacities=opacities.logit(),
        sh0=torch.randn(count, 1, 3, generator=rng) * 0.7,
        shN=torch.randn(count, 15, 3, generator=rng) * 0.1,
    )
    viewmats = look_at(torch.tensor([EYE]), torch.tensor([0.0, 0.0, -0.05]), torch.tensor([0.0, 0.0, 1.0]))
    K = intrinsics(FOV, width, height).float()
    return gaussians, Cameras(viewmats, K[None], width, height)


def surface_points(count: int, rng: torch.Generator) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Points spread evenly over the three surfaces by area, and the normals there."""
    areas = torch.tensor(
        [4 * math.pi**2 * TORUS_RADIUS * TUBE_RADIUS, 4 * math.pi * SPHERE_RADIUS**2, math.pi * GROUND_RADIUS**2]
    )
    shares = [int(n) for n in (count * areas / areas.sum()).round()]
    shares[2] = count - shares[0] - shares[1]
    parts = [torus(shares[0], rng), sphere(shares[1], rng), ground(shares[2], rng)]
    return torch.cat([points for points, _ in parts]), torch.cat([normals for _, normals in parts])


def torus(count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    around = 2 * math.pi * torch.rand(count, generator=rng)
    # Area grows with the distance from the axis: rejection sampling of the tube angle (Williamson 1987).
    tube, keep = (
        torch.rand(2, 8 * count, generator=rng) * torch.tensor([[2 * math.pi], [1 + TUBE_RADIUS / TORUS_RADIUS]])
    ).unbind()
    tube = tube[keep < 1 + TUBE_RADIUS / TORUS_RADIUS * tube.cos()][:count]
    normals = torch.stack([around.cos() * tube.cos(), around.sin() * tube.cos(), tube.sin()], dim=1)
    ring = torch.stack([around.cos(), around.sin(), torch.zeros(count)], dim=1)
    return TORUS_RADIUS * ring + TUBE_RADIUS * normals, normals


def sphere(count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    return SPHERE_RADIUS * normals + torch.tensor([0.0, 0.0, 0.6]), normals


def ground(count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    radius = GROUND_RADIUS * torch.rand(count, generator=rng).sqrt()
    angle = 2 * math.pi * torch.rand(count, generator=rng)
    points = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full((count,), -TUBE_RADIUS)], dim=1)
    return points, torch.tensor([0.0, 0.0, 1.0]).expand(count, 3)


def rotations_from_normals(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Rotations whose third column is the normal."""
    helper = torch.where(normals[:, 2:].abs() < 0.9, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0]))
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, normals), dim=1)
    return torch.stack([x, torch.linalg.cross(normals, x), normals], dim=2)
