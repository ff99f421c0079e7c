"""The point of the surface that a ray meets first: where half of the light is gone.

A splat stands where its density along the ray is greatest, which for a flat one is its plane, not the depth of its
center. The blur of the image model makes it wider by so many pixels. web/worker.js does the same in the page.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import rotation_matrices

EPS2D = 0.3
"""Blur of the image model, px² (docs/math.md, eq. 4)."""
REACH2 = 12.0
"""Squared standard deviations beyond which a splat of full opacity is not drawn."""
MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99


def surface_along(
    gaussians: Gaussians, eye: Float[Tensor, "3"], ray: Float[Tensor, "3"], focal: float
) -> Float[Tensor, "3"] | None:
    """The first point at which a ray's transmittance is one half, or None; `focal`: of the image, px."""
    eye, ray = eye.double(), torch.nn.functional.normalize(ray.double(), dim=0)
    away = eye - gaussians.means.double()
    depth = -(away @ ray)
    extra = EPS2D * (depth / focal).square()
    scales = gaussians.scales.double()
    aside = away.square().sum(1) - depth.square()
    near = (depth > 0) & (aside <= REACH2 * (scales.amax(1).square() + extra))
    widths = (scales[near].square() + extra[near, None]).sqrt()
    axes = rotation_matrices(gaussians.quats[near].double()).mT
    o, d = (axes @ away[near][..., None])[..., 0] / widths, (axes @ ray) / widths
    at = -(o * d).sum(1) / d.square().sum(1)
    power = o.square().sum(1) - at.square() * d.square().sum(1)
    alphas = gaussians.opacities[near].double() * (-0.5 * power).exp()
    drawn = (at > 0) & (alphas >= MIN_ALPHA)
    at, order = at[drawn].sort(stable=True)
    left = torch.cumprod(1 - alphas[drawn][order].clamp(max=MAX_ALPHA), dim=0)
    stopped = (left <= 0.5).nonzero()
    return (eye + at[stopped[0, 0]] * ray).float() if len(stopped) else None
