"""Lens models: from ideal (pinhole) image coordinates to the coordinates a real lens produces.

One formula covers the models of OpenCV, COLMAP, nerfstudio and instant-ngp: an optional equidistant fisheye mapping,
then the Brown-Conrady polynomial with rational divisor, tangential and thin-prism terms (OpenCV, "Camera Calibration
and 3D Reconstruction"; COLMAP, src/colmap/sensor/models.h; Kannala and Brandt 2006 for the fisheye).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Lens:
    """Distortion of normalized image coordinates (x/z, y/z); all zero and no fisheye is a pinhole."""

    radial: tuple[float, ...] = ()
    """k1, k2, ...: coefficients of r², r⁴, ..."""
    divisor: tuple[float, ...] = ()
    """k4, k5, k6 of OpenCV's rational model: 1 + k4 r² + ... divides the radial factor."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2."""
    prism: tuple[float, float] = (0.0, 0.0)
    """sx1, sy1 of the thin-prism model."""
    fisheye: bool = False
    """First map r = tan(theta) to theta, the angle off the axis."""

    @property
    def is_pinhole(self) -> bool:
        return not (self.fisheye or any((*self.radial, *self.divisor, *self.tangential, *self.prism)))

    def distort(self, xy: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 2"]:
        """Point of the real lens's image plane (focal length 1) that a ray through ideal coordinates `xy` meets."""
        if self.fisheye:
            xy = xy * _theta_over_tan(xy.square().sum(-1, keepdim=True).sqrt())
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        factor = (1 + _polynomial(self.radial, r2)) / (1 + _polynomial(self.divisor, r2))
        (p1, p2), (s1, s2) = self.tangential, self.prism
        u = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2
        v = y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s2 * r2
        return torch.stack([u, v], dim=-1)


def _polynomial(coefficients: tuple[float, ...], r2: Tensor) -> Tensor:
    """c1 r² + c2 r⁴ + ..., by Horner's rule."""
    total = torch.zeros_like(r2)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * r2
    return total


def _theta_over_tan(r: Tensor) -> Tensor:
    """atan(r) / r, 1 at the axis."""
    safe = r.clamp(min=1e-9)
    return torch.where(r < 1e-9, torch.ones_like(r), torch.atan(safe) / safe)
