"""Coverage of each Gaussian by the input views, and the uncertainty of a new view that follows.

    coverage_i = sum over input views of  visible · facing,        uncertainty u_i = exp(-coverage_i)

visible: the center projects into the view and nothing opaque lies before it. facing: 1 for a Gaussian as round as a
ball, less for a flat one seen edge-on. Rendered as a color, u tells for every pixel how free the inputs left it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.farthest_points import farthest_points
from gsopt.geometry.projection import inside, project
from gsopt.geometry.quats import rotation_matrices
from gsopt.geometry.sh import sh0_from_rgb
from gsopt.raster.api import expected_depth
from gsopt.raster.backend import Backend, RasterSettings

MAX_VIEWS = 32
"""Input views that are looked through, the farthest apart: coverage saturates long before."""
DEPTH_MAP_SIDE = 128
"""Longer side of the depth maps, px."""
DEPTH_SLACK = 0.02
"""Share of the depth by which a center may lie behind the surface and still count as visible."""
SCALE_SLACK = 2.0
"""The same in largest standard deviations of the Gaussian."""
SOLID = 0.5
"""Alpha from which on a pixel hides what is behind it."""
EDGE_ON, FACE_ON = 0.1, 0.5
"""|cos| between view and normal at which a flat Gaussian counts as unseen and as fully seen."""
PLAIN = RasterSettings(sh_degree=0)


def coverage(gaussians: Gaussians, inputs: Sequence[Cameras], backend: Backend) -> Float[Tensor, "N"]:
    """Number of input views that see each Gaussian; at most MAX_VIEWS. On the CPU, as all that guidance keeps."""
    total = torch.zeros(len(gaussians))
    for camera in spread(inputs):
        total += seen(gaussians, _small(camera), backend).cpu()
    return total


def uncertainty(coverage: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """u: 1 where no input sees a Gaussian, 0.37 where one does, next to 0 from three or four on."""
    return torch.exp(-coverage)


def seen(gaussians: Gaussians, camera: Cameras, backend: Backend) -> Float[Tensor, "N"]:
    """visible · facing in one view, 0 to 1."""
    frame = backend.forward(gaussians, camera, PLAIN, depth=True)
    assert frame.depths is not None
    surface = expected_depth(frame.depths, frame.alphas)
    camera = camera.to(gaussians.means.device)
    column, row, depth = project(camera, gaussians.means)
    shown = inside(camera, column, row, depth)
    i = torch.where(shown, row, 0.0).long().clamp(0, camera.height - 1)
    j = torch.where(shown, column, 0.0).long().clamp(0, camera.width - 1)
    slack = DEPTH_SLACK * surface[i, j] + SCALE_SLACK * gaussians.scales.amax(-1)
    hidden = (frame.alphas[i, j] > SOLID) & (depth > surface[i, j] + slack)
    return torch.where(shown & ~hidden, facing(gaussians, camera.centers[0]), 0.0)


def facing(gaussians: Gaussians, eye: Float[Tensor, "3"]) -> Float[Tensor, "N"]:
    """Visibility by orientation: 1 for balls; for discs a smooth step over |cos| to the shortest axis."""
    scales = gaussians.scales
    order = scales.sort(dim=-1)
    normal = rotation_matrices(gaussians.quats).gather(2, order.indices[:, None, :1].expand(-1, 3, 1))[..., 0]
    towards = torch.nn.functional.normalize(eye.to(gaussians.means) - gaussians.means, dim=-1)
    cosine = (normal * towards).sum(-1).abs()
    x = ((cosine - EDGE_ON) / (FACE_ON - EDGE_ON)).clamp(0, 1)
    flatness = 1 - order.values[:, 0] / order.values[:, 1].clamp_min(1e-12)
    return 1 - flatness * (1 - x * x * (3 - 2 * x))


def uncertainty_map(
    gaussians: Gaussians, u: Float[Tensor, "N"], camera: Cameras, backend: Backend
) -> Float[Tensor, "H W"]:
    """sum T alpha u: the uncertainty of what a camera sees, 0 where it sees nothing."""
    return backend.forward(_painted(gaussians, u), camera, PLAIN).colors[..., 0].clamp(0, 1).cpu()


def mean_uncertainty(
    gaussians: Gaussians, u: Float[Tensor, "N"], cameras: Cameras, backend: Backend
) -> Float[Tensor, "C"]:
    """Over what each camera sees, weighted by alpha; 0 for a camera that sees nothing."""
    painted, means = _painted(gaussians, u), []
    for c in range(len(cameras)):
        frame = backend.forward(painted, cameras[c], PLAIN)
        means.append(frame.colors[..., 0].sum() / frame.alphas.sum().clamp_min(1e-6))
    return torch.stack(means).clamp(0, 1).float().cpu()


def _painted(gaussians: Gaussians, u: Float[Tensor, "N"]) -> Gaussians:
    """The same shapes with u as their color from every side."""
    gray = u.to(gaussians.means)[:, None, None].expand(-1, 1, 3)
    return replace(gaussians, sh0=sh0_from_rgb(gray).contiguous(), shN=gaussians.shN[:, :0].contiguous())


def spread(inputs: Sequence[Cameras]) -> list[Cameras]:
    """At most MAX_VIEWS of the cameras."""
    if len(inputs) <= MAX_VIEWS:
        return list(inputs)
    return [inputs[row] for row in sorted(farthest_points(torch.cat([camera.centers for camera in inputs]), MAX_VIEWS))]


def _small(camera: Cameras) -> Cameras:
    scale = min(1.0, DEPTH_MAP_SIDE / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    return small.to(torch.float32)
