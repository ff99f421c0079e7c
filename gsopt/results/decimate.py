"""Fewer splats by merging neighbors: a level of detail.

Splats are paired along a Morton curve and the cheapest pairs merged, round by round. A merged splat has the mean,
covariance and color of both, weighted by opacity times area, and the opacity that keeps the sum of opacity times area.
The cost of a pair grows with what both contribute: by the pixels of input views where there are any, and then half of
the splats that go are those that contribute least; else by opacity times area.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gsopt import check
from gsopt.gaussians import Gaussians
from gsopt.geometry.morton import morton_order
from gsopt.geometry.quats import from_rotation_matrices, normalize, rotation_matrices
from gsopt.raster.threads import one_torch_thread

MOST_MERGED = 0.2
"""Share of the splats that a round may take away: the others find better partners in the next."""
COLOR_WEIGHT = 0.5
"""Cost of a unit of sh0 in color, beside that of a standard deviation of distance."""
PRUNED = 0.5
"""Share of what goes that is left out by its contribution instead of merged; measured in howto/formats.md."""
MAX_OPACITY = 0.995
_SMALLEST = 1e-14


@one_torch_thread()
def decimated(gaussians: Gaussians, share: float, contributions: Float[Tensor, "N"] | None = None) -> Gaussians:
    """About `share` of the splats (at least one). The same input gives the same bits.

    `contributions`: of each splat to the input views, px (`clean.observe`); all are merged by their own mass without.
    """
    check.within("--decimate", share, 1e-6, 1.0, "Give a share as 25%.")
    target, turn = max(1, round(share * len(gaussians))), 0
    if contributions is None:
        weights = masses(gaussians)
    else:
        most = torch.argsort(contributions, descending=True, stable=True)
        kept = most[: len(gaussians) - int(PRUNED * (len(gaussians) - target))].sort().values
        gaussians, weights = gaussians.select(kept), contributions[kept].double()
    while len(gaussians) > target:
        wanted = min(len(gaussians) - target, max(1, int(MOST_MERGED * len(gaussians))))
        gaussians, weights = _merged_round(gaussians, weights, wanted, turn)
        turn = 1 - turn if len(gaussians) > 2 else 0
    return gaussians


def _merged_round(
    gaussians: Gaussians, weights: Float[Tensor, "N"], wanted: int, turn: int
) -> tuple[Gaussians, Float[Tensor, "M"]]:
    """Merges up to `wanted` pairs of neighbors along the curve, beginning with row `turn`; weights add up."""
    order = morton_order(gaussians.means.double())
    pairs = order[turn : turn + 2 * ((len(order) - turn) // 2)].view(-1, 2)
    chosen = torch.argsort(_costs(gaussians, weights, pairs), stable=True)[:wanted]
    pairs = pairs[chosen.sort().values]
    left: Bool[Tensor, "N"] = torch.ones(len(gaussians), dtype=torch.bool)
    left[pairs.flatten()] = False
    both = gaussians.select(left).append(merged(gaussians, pairs))
    return both, torch.cat([weights[left], weights[pairs].sum(1)])


def _costs(gaussians: Gaussians, weights: Float[Tensor, "N"], pairs: Int[Tensor, "P 2"]) -> Float[Tensor, "P"]:
    """Weight that moves, times how far: in standard deviations and in color (Ward 1963)."""
    a, b = pairs.unbind(1)
    reduced = weights[a] * weights[b] / (weights[a] + weights[b]).clamp_min(1e-300)
    size = gaussians.scales.double().square().mean(1)
    apart = (gaussians.means[a] - gaussians.means[b]).double().square().sum(1) / (size[a] + size[b]).clamp_min(1e-300)
    color = (gaussians.sh0[a, 0] - gaussians.sh0[b, 0]).double().square().sum(1)
    return reduced * (apart + COLOR_WEIGHT * color)


def masses(gaussians: Gaussians) -> Float[Tensor, "N"]:
    """Opacity times the area of the two longest axes."""
    return gaussians.opacities.double() * _areas(gaussians.scales.double())


def _areas(scales: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    longest = scales.sort(dim=1, descending=True).values
    return longest[:, 0] * longest[:, 1]


def merged(gaussians: Gaussians, pairs: Int[Tensor, "P 2"]) -> Gaussians:
    """One splat in place of each pair."""
    mass = masses(gaussians)[pairs].clamp_min(1e-300)
    weight = (mass / mass.sum(1, keepdim=True))[..., None]
    means = gaussians.means.double()[pairs]
    mean = (weight * means).sum(1)
    turns = rotation_matrices(normalize(gaussians.quats.double()))[pairs]
    spread = turns * gaussians.scales.double()[pairs][:, :, None, :]
    apart = means - mean[:, None]
    cov = spread @ spread.mT + apart[..., :, None] * apart[..., None, :]
    variances, axes = torch.linalg.eigh((weight[..., None] * cov).sum(1))
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    scales = variances.clamp_min(_SMALLEST**2).sqrt()
    opacity = (mass.sum(1) / _areas(scales)).clamp(1e-6, MAX_OPACITY)
    like, colors = gaussians.means.dtype, weight[..., None]
    return Gaussians(
        means=mean.to(like),
        quats=from_rotation_matrices(axes).to(like),
        log_scales=scales.log().to(like),
        logit_opacities=torch.logit(opacity).to(like),
        sh0=(colors * gaussians.sh0.double()[pairs]).sum(1).to(like),
        shN=(colors * gaussians.shN.double()[pairs]).sum(1).to(like),
    )
