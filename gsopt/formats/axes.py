"""Conversion from the axes of a PLY (x right, y down, z forward) to those of another format, by flipping axes.

Flips only change signs, so a round trip gives the same bits. For S = diag(signs) a mean m becomes
S m and a rotation R becomes S R S, which transforms the covariance R D² Rᵀ like the means because S D² S = D².
A spherical harmonic is even or odd in each axis (gsopt.geometry.sh lists the polynomials), which gives its sign.
"""

from __future__ import annotations

import math

import torch

from gsopt.gaussians import Gaussians

Signs = tuple[int, int, int]

RIGHT_UP_BACK: Signs = (1, -1, -1)
"""OpenGL and three.js, which .spz uses (its README, "Coordinate System")."""
LEFT_UP_FORWARD: Signs = (-1, -1, 1)
"""glTF 2.0, section 3.4: +y up, the front of an asset faces +z."""

_ODD_IN = ("y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""The axes in which Y_1 .. Y_15 are odd."""


def with_flipped_axes(gaussians: Gaussians, signs: Signs) -> Gaussians:
    """The same splats with flipped axes where the sign is -1; its own inverse. A proper rotation flips two."""
    x, y, z = signs
    sign = {"x": x, "y": y, "z": z}
    parities = [math.prod(sign[axis] for axis in axes) for axes in _ODD_IN[: gaussians.shN.shape[1]]]
    return Gaussians(
        means=gaussians.means * torch.tensor([x, y, z]),
        quats=gaussians.quats * torch.tensor([1, y * z, x * z, x * y]),
        log_scales=gaussians.log_scales,
        logit_opacities=gaussians.logit_opacities,
        sh0=gaussians.sh0,
        shN=gaussians.shN * torch.tensor(parities, dtype=torch.int64)[:, None],
    )
