"""Small rigid motions: a turn and a shift in six numbers."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def rigid_motion(xi: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """[exp(omega) tau; 0 1]: a rotation by |omega| (Rodrigues) and a shift, orthonormal to rounding."""
    omega, tau = xi[:3], xi[3:]
    angle = float(omega.norm())
    w = omega.tolist()
    cross = torch.tensor([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]], dtype=xi.dtype)
    sine = math.sin(angle) / angle if angle > 1e-12 else 1.0
    versine = 2 * (math.sin(angle / 2) / angle) ** 2 if angle > 1e-12 else 0.5
    motion = torch.eye(4, dtype=xi.dtype)
    motion[:3, :3] += sine * cross + versine * cross @ cross
    motion[:3, 3] = tau
    return motion
