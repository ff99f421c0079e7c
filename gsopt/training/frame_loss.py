"""The loss of one rendered frame against its view, and its gradients."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.geometry.precision import widest
from gsopt.raster.backend import Backend, RenderedFrame
from gsopt.training.exposure import Exposure
from gsopt.training.plan import LossWeights
from gsopt.training.regularizers import alpha_gradient
from gsopt.training.targets import Target

SOLID = 0.5
"""Alpha from which on a render has a depth."""
LEAST_DEPTH_PIXELS = 16
"""Pixels below which a correlation of depths says nothing."""
LEAST_VARIANCE = 1e-12
"""Variance of inverse depths, in squared means, below which a surface is flat as seen from the camera."""
MAX_ERROR = 0.2
"""Share of an inverse depth by which a render may miss it and still be drawn to it: photos agree on wrong ones too."""


@dataclass(frozen=True)
class FrameLoss:
    """The photometric loss, and the gradients of all terms that look at the frame."""

    photometric: float
    v_colors: Float[Tensor, "H W 3"]
    v_alphas: Float[Tensor, "H W"] | None
    v_depths: Float[Tensor, "H W"] | None


def frame_loss(
    backend: Backend,
    frame: RenderedFrame,
    target: Target,
    weights: LossWeights,
    background: Float[Tensor, "3"],
    exposure: Exposure | None,
    row: int | None,
    step: int,
) -> FrameLoss:
    """The loss of `frame`, drawn on `background`, against `target`, which shows photo `row`; the photo's exposure
    takes a step."""
    behind = None if target.alphas is None else background
    exposed = frame.colors if exposure is None or row is None else exposure.exposed(row, frame, behind)
    photometric = backend.photometric(exposed, target.colors, weights.dssim)
    weight = target.share * target.color
    v_colors = photometric.v_colors if weight == 1 else photometric.v_colors.mul_(weight)
    v_alphas = v_depths = None
    if exposure is not None and row is not None:
        v_colors, v_alphas = exposure.backward(row, step, frame, behind, v_colors)
    if weights.alpha > 0 and target.alphas is not None:
        v_alphas = _sum(v_alphas, alpha_gradient(frame.alphas, target.alphas, weights.alpha * target.share))
    if target.inverse_depths is not None and frame.depths is not None:
        gradients_of = agreed_gradients if weights.agreed > 0 else depth_gradients
        depth_weight = weights.agreed or weights.depth
        through = gradients_of(frame.depths, frame.alphas, target, depth_weight * target.share)
        v_depths, v_alphas = through[0], _sum(v_alphas, through[1])
    return FrameLoss(photometric.loss * weight, v_colors, v_alphas, v_depths)


def depth_gradients(
    depths: Float[Tensor, "H W"], alphas: Float[Tensor, "H W"], target: Target, weight: float
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """d/d(depths, alphas) of weight · (1 - rho), rho the correlation (Pearson's) of the rendered inverse depth
    w = alphas / depths with that of the target, over the pixels where both are known: no scale and no shift of the
    target changes it (Ranftl et al. 2020; as a correlation: Zhu et al. 2024, "FSGS"). With unit vectors w', y' of the
    n centered values, d(rho)/dw = (y' - rho w') / |w - mean w|."""
    known, w, y = _inverse_depths(depths, alphas, target)
    if len(w) < LEAST_DEPTH_PIXELS:
        return torch.zeros_like(depths), torch.zeros_like(alphas)
    w_unit, w_length = _centered_unit(w)
    y_unit, y_length = _centered_unit(y)
    if min(w_length, y_length) == 0:
        return torch.zeros_like(depths), torch.zeros_like(alphas)
    v_w = -weight * (y_unit - (y_unit @ w_unit) * w_unit) / w_length
    return _through_inverse(v_w, w, known, depths, alphas)


def agreed_gradients(
    depths: Float[Tensor, "H W"], alphas: Float[Tensor, "H W"], target: Target, weight: float
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """d/d(depths, alphas) of weight · the mean over the image of |w / y - 1|, y an inverse depth on which photos agree,
    in scene units; 0 where none is known, and where the render w misses it by more than MAX_ERROR."""
    known, w, y = _inverse_depths(depths, alphas, target)
    error = w / y - 1
    v_w = weight / depths.numel() * error.sign() / y * (error.abs() < MAX_ERROR)
    return _through_inverse(v_w, w, known, depths, alphas)


def _inverse_depths(
    depths: Float[Tensor, "H W"], alphas: Float[Tensor, "H W"], target: Target
) -> tuple[Bool[Tensor, "H W"], Float[Tensor, "N"], Float[Tensor, "N"]]:
    """The pixels that have a depth in both, and the inverse depths there: the rendered w = alphas / depths, and the
    target's."""
    assert target.inverse_depths is not None
    known = torch.isfinite(target.inverse_depths) & (alphas > SOLID) & (depths > 0)
    if target.alphas is not None:
        known &= target.alphas > SOLID
    D, A, y = (values[known].to(widest(depths.device)) for values in (depths, alphas, target.inverse_depths))
    return known, A / D, y


def _through_inverse(
    v_w: Float[Tensor, "N"],
    w: Float[Tensor, "N"],
    known: Bool[Tensor, "H W"],
    depths: Float[Tensor, "H W"],
    alphas: Float[Tensor, "H W"],
) -> tuple[Float[Tensor, "H W"], Float[Tensor, "H W"]]:
    """d/d(depths, alphas) from d/dw, w = alphas / depths at the known pixels."""
    v_depths, v_alphas = torch.zeros_like(depths), torch.zeros_like(alphas)
    D = depths[known].to(w)
    v_depths[known] = (-v_w * w / D).to(depths)
    v_alphas[known] = (v_w / D).to(alphas)
    return v_depths, v_alphas


def _centered_unit(values: Float[Tensor, "N"]) -> tuple[Float[Tensor, "N"], float]:
    """The values less their mean, as a unit vector, and its length; length 0 where they are all alike."""
    centered = values - values.mean()
    length = float(centered.norm())
    alike = length**2 <= LEAST_VARIANCE * float(values.square().sum())
    return (centered, 0.0) if alike else (centered / length, length)


def _sum(one: Tensor | None, other: Tensor) -> Tensor:
    return other if one is None else one.add_(other)
