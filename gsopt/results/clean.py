"""Finds splats that no input view needs: unseen ones, haze before the cameras, background outside masks or a box.

Decided by what the input views see. The weight of a splat in a view is the sum of T alpha over its pixels, the gradient
of a constant image with respect to its color. A rule that lowers the PSNR of the input views is not followed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.data.scene import View
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.projection import project
from gsopt.metrics import capped_psnr
from gsopt.raster.api import Rendering, rasterize
from gsopt.raster.backend import ALPHA_MIN, Backend, RasterSettings
from gsopt.raster.threads import one_torch_thread
from gsopt.results.finished_run import FinishedRun, draw, truth

UNSEEN_WEIGHT = 0.005
"""Mean weight per input view, px, below which a splat is unseen; held-out views do not miss it (howto/clean.md)."""
OUTSIDE_SHARE = 0.8
"""Share of a splat's weight on pixels outside the masks from which on it is background."""
HAZE_DEPTH, HAZE_VIEWS, FEWEST_VIEWS = 0.5, 2, 6
"""Haze lies before this share of the nearest surfaces' depth, and no more than so many of six or more views see it."""
NEAREST = 0.05
"""Quantile of a view's depths that counts as its nearest surfaces."""
SEEN = 0.5
"""Weight, px, from which on a view sees a splat."""
LEFT_OUT_VIEWS = 8
"""Most input views that `left_out_change` leaves out, one after the other."""
MAX_COST = 0.02
"""dB of input-view PSNR that one rule may cost: floaters before a camera help that one camera."""
CHECKED_VIEWS = 24
PLAIN = RasterSettings(sh_degree=0)


@dataclass(frozen=True)
class Observation:
    """Weights and depths of each splat in the input views."""

    weight: Float[Tensor, "N"]
    """Sum over all views, px."""
    outside: Float[Tensor, "N"]
    """The part of it on pixels outside the masks."""
    views: Float[Tensor, "N"]
    """Number of views that see it."""
    nearness: Float[Tensor, "N"]
    """Least depth in a view, as a share of that view's nearest surfaces."""


@dataclass(frozen=True)
class Finding:
    """One rule, the splats it names, and what leaving them out changes in the input views."""

    rule: str
    splats: Bool[Tensor, "N"]
    change: float | None
    """dB of input-view PSNR, or None where no view decides."""
    followed: bool


@one_torch_thread()
def observe(gaussians: Gaussians, views: Sequence[View], backend: Backend) -> Observation:
    """Weights of every splat in the input views."""
    n = len(gaussians)
    weight, outside, count, nearness = torch.zeros(n), torch.zeros(n), torch.zeros(n), torch.full((n,), math.inf)
    for view in views:
        in_view, beyond, depths = _weights(gaussians, view, backend)
        weight, outside, count = weight + in_view, outside + beyond, count + (in_view > SEEN)
        nearness = torch.where(in_view > 0.1 * SEEN, torch.minimum(nearness, depths), nearness)
    return Observation(weight, outside, count, nearness)


def _weights(gaussians: Gaussians, view: View, backend: Backend) -> tuple[Tensor, Tensor, Tensor]:
    """(weight, weight outside the mask, depth as a share of the nearest surfaces') of each splat in one view."""
    image = view.pixels()
    outside = image[..., 3] < 128 if image.shape[2] == 4 else torch.zeros(image.shape[:2])
    sums, drawn = pixel_sums(gaussians, view, backend, torch.stack([torch.ones(image.shape[:2]), outside], dim=2))
    assert drawn.depths is not None
    solid = drawn.depths[drawn.alphas > 0.5].detach().cpu()
    nearest = float(solid.sort().values[int(NEAREST * len(solid))]) if len(solid) else math.inf
    return sums[:, 0], sums[:, 1], project(view.camera.to(torch.float32), gaussians.means)[2] / nearest


def pixel_sums(
    gaussians: Gaussians, view: View, backend: Backend, image: Float[Tensor, "H W 2"]
) -> tuple[Float[Tensor, "N 2"], Rendering]:
    """The sum over a view's pixels of T alpha times each channel of `image`, for every splat, and a render's depths."""
    colors = torch.zeros(len(gaussians), 1, 3, device=backend.device, requires_grad=True)
    shapes = replace(gaussians, shN=gaussians.shN[:, :0].contiguous()).to(backend.device)
    drawn = rasterize(replace(shapes, sh0=colors), view.camera.to(torch.float32), PLAIN, backend=backend, depth=True)
    pixels = torch.zeros_like(drawn.colors)
    pixels[0, ..., :2] = image.to(pixels)
    drawn.colors.backward(pixels)
    assert colors.grad is not None
    return colors.grad[:, 0, :2].cpu() / sh.C0, drawn


@one_torch_thread()
def findings(run: FinishedRun, views: Sequence[View], box: tuple[float, ...] | None = None) -> list[Finding]:
    """Every rule and the splats it names, in the order in which they are followed; a splat is named once."""
    seen = observe(run.gaussians, views, run.backend)
    rules = {"unseen": seen.weight < UNSEEN_WEIGHT * len(views)}
    if len(views) >= FEWEST_VIEWS:
        rules["haze"] = (seen.nearness < HAZE_DEPTH) & (seen.views <= HAZE_VIEWS)
    rules["outside the masks"] = seen.outside > OUTSIDE_SHARE * seen.weight.clamp_min(1e-9)
    if box is not None:
        rules["outside the box"] = outside_box(run.gaussians, box)
    checked = list(views)[:: -(-len(views) // CHECKED_VIEWS)]
    gone = torch.zeros(len(run.gaussians), dtype=torch.bool)
    found, before = [], input_psnr(run, run.gaussians, checked)
    for rule, named in rules.items():
        named = named & ~gone
        if not bool(named.any()):
            continue
        after = input_psnr(run, run.gaussians.select(~(gone | named)), checked)
        followed = after >= before - MAX_COST or rule == "outside the box"
        found.append(Finding(rule, named, after - before, followed))
        if followed:
            gone, before = gone | named, after
    return found


@one_torch_thread()
def left_out_change(run: FinishedRun, views: Sequence[View]) -> float:
    """Mean change in dB of an input view when all others decide what goes; NaN where there are no others.

    A view that was trained on shows splats that no other needs, so that this is more than new views lose.
    """
    changes = []
    for number in range(0, len(views), -(-len(views) // LEFT_OUT_VIEWS)) if len(views) > 1 else ():
        others = [view for i, view in enumerate(views) if i != number]
        keep = kept(findings(run, others), len(run.gaussians))
        judged = [views[number]]
        changes.append(input_psnr(run, run.gaussians.select(keep), judged) - input_psnr(run, run.gaussians, judged))
    return sum(changes) / len(changes) if changes else math.nan


def findings_without_views(gaussians: Gaussians, box: tuple[float, ...] | None = None) -> list[Finding]:
    """Splats of a file that nobody can see: opacity below the rasterizer's least alpha, and those outside a box."""
    faint = gaussians.opacities < ALPHA_MIN
    found = [Finding("invisible", faint, None, True)]
    if box is not None:
        found.append(Finding("outside the box", outside_box(gaussians, box) & ~faint, None, True))
    return [finding for finding in found if bool(finding.splats.any())]


def outside_box(gaussians: Gaussians, box: tuple[float, ...]) -> Bool[Tensor, "N"]:
    """Centers outside x, y, z, X, Y, Z."""
    low, high = torch.tensor(box[:3]), torch.tensor(box[3:])
    return ((gaussians.means < low) | (gaussians.means > high)).any(dim=1)


@one_torch_thread()
def input_psnr(run: FinishedRun, gaussians: Gaussians, views: Sequence[View]) -> float:
    """Mean PSNR of the views, dB."""
    total = 0.0
    for view in views:
        drawn, target = (
            draw(gaussians, view.camera, run.backend, run.settings, run.background),
            truth(view, run.background),
        )
        total += float(capped_psnr(drawn[None].float() / 255, target[None].float() / 255))
    return total / max(1, len(views))


def kept(found: Sequence[Finding], count: int) -> Bool[Tensor, "N"]:
    """True for the splats that no followed rule names."""
    gone = torch.zeros(count, dtype=torch.bool)
    for finding in found:
        if finding.followed:
            gone |= finding.splats
    return ~gone
