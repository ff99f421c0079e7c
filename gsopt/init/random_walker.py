"""Segmentation by a random walker: each pixel takes the side that a walk from it most likely ends on, where steps
across an edge of the image are unlikely (Grady 2006; with likelihoods instead of seeds: Grady 2005).

With colors c and likelihoods p, the probabilities x minimize sum w (x_i - x_j)² + TRUST · sum (x_i - p_i)², the first
sum over pairs of neighbors with w = exp(-|c_i - c_j|² / 2 s²), s² the mean of |c_i - c_j|²: a linear system, solved by
conjugate gradients.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

TRUST = 0.05
"""Weight of a pixel's own likelihood against its neighbors."""
LEAST_WEIGHT = 1e-4
"""Weight of a step across the strongest edge."""
MAX_STEPS, TOLERANCE = 300, 1e-5
"""End of the conjugate gradients; 300 x 300 pixels take 50 to 100 steps."""


def walked(colors: UInt8[Tensor, "3 H W"], likely: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Probabilities of the pixels from what each alone says (0..1), smoothed within the image's edges."""
    weights = _step_weights(colors.double())
    p = likely.double()
    diagonal = _laplacian_diagonal(weights, p.shape) + TRUST
    x = p.clone()
    residual = TRUST * p - _applied(weights, x)
    scaled = residual / diagonal
    direction, power = scaled, (residual * scaled).sum()
    for _ in range(MAX_STEPS):
        if float(residual.abs().max()) < TOLERANCE:
            break
        image = _applied(weights, direction)
        step = power / (direction * image).sum()
        x = x + step * direction
        residual = residual - step * image
        scaled = residual / diagonal
        before, power = power, (residual * scaled).sum()
        direction = scaled + power / before * direction
    return x.float()


def _step_weights(colors: Tensor) -> tuple[Tensor, Tensor]:
    """w of the steps to the right [H, W-1] and down [H-1, W]."""
    squares = [colors.diff(dim=dim).square().sum(0) for dim in (2, 1)]
    mean = torch.cat([square.flatten() for square in squares]).mean().clamp_min(1e-9)
    right, down = ((-square / (2 * mean)).exp() + LEAST_WEIGHT for square in squares)
    return right, down


def _applied(weights: tuple[Tensor, Tensor], x: Tensor) -> Tensor:
    """(L + TRUST) x with L the Laplacian of the weights."""
    right, down = weights
    out = TRUST * x
    across, along = right * x.diff(dim=1), down * x.diff(dim=0)
    out[:, 1:] += across
    out[:, :-1] -= across
    out[1:] += along
    out[:-1] -= along
    return out


def _laplacian_diagonal(weights: tuple[Tensor, Tensor], shape: torch.Size) -> Tensor:
    right, down = weights
    out = torch.zeros(shape, dtype=torch.float64)
    out[:, 1:] += right
    out[:, :-1] += right
    out[1:] += down
    out[:-1] += down
    return out
