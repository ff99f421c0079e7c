"""Guidance losses: a prior's prediction becomes a target for the render, with the gradient in closed form.

    (1)  L = 1/2 mean( u (z - sg[z - g])^2 )          so that dL/dz = u g / numel,   sg: no gradient passes

z is the render in the prior's space, u the weight of every pixel. The mean (not the sum) makes lambda independent of
the resolution. g depends on the policy:

    sds    g = w(t) (eps_hat - eps) = w(t) sqrt(a/(1-a)) (z - x0_hat)                (Poole et al. 2022, eq. 3)
    sdi    the same, with the noise that DDIM inversion finds for z                    (Lukoianov et al. 2024)

recon compares pixels instead, by the distance that most of the photometric loss is (Zhou & Tulsiani 2023):

    (2)  L = mean( u sqrt((x - y)^2 + e^2) ),   y denoised from z_t, e = ROUNDING

y is kept for some hundred steps, in which the render goes on from the x' it was made of. The prior's change is
y - x', so u is multiplied by its size, and by 0 where the render has passed y by itself: else an old target,
which is mostly an old render, would hold the reconstruction back.

    (3)  u' = u c^2 / (c^2 + CHANGE_SCALE^2) [c (y - x) > 0],   c = y - x'
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.sds.noise import Latents, Signal, add_noise, eps_from, weight
from gsopt.sds.priors.protocol import Images, Pair, Prior, Scale, guided_x0

ROUNDING = 0.01
"""Differences well below this count by their square: no gradient jumps where the render has arrived."""

CHANGE_SCALE = 0.05
"""Changes well below this are not what a prior wants, but what it cannot know better."""


@dataclass(frozen=True)
class NoiseSample:
    """Random numbers and settings of one guided step."""

    t: int
    eps: Latents
    pair: Pair
    scale: Scale
    weighting: str = "sigma2"
    clip_rms: float = 0.0
    """Largest root mean square of g; 0 = any."""


@dataclass(frozen=True)
class GuidanceGradient:
    """The gradient of score distillation and the estimate it comes from."""

    g: Latents
    """dL/dz times numel, before the pixel weights."""
    x0: Latents
    """The prior's estimate of the clean image."""


def sds(prior: Prior, z: Latents, noise: NoiseSample) -> GuidanceGradient:
    """Score distillation from one noisy copy of `z`."""
    z = z.detach()
    return _distilled(prior, z, add_noise(z, noise.eps, _signal(prior, noise.t, z)), noise)


def sdi(prior: Prior, z: Latents, noise: NoiseSample, steps: int) -> GuidanceGradient:
    """Score distillation whose noise belongs to `z`: nothing random but t, less variance, `steps` more calls."""
    z = z.detach()
    return _distilled(prior, z, inverted(prior, z, noise, steps), noise)


def _distilled(prior: Prior, z: Latents, x_t: Latents, noise: NoiseSample) -> GuidanceGradient:
    """g from the noisy copy; x_t fixes the noise, so eps_hat - eps = sqrt(a/(1-a)) (z - x0_hat)."""
    signal = _signal(prior, noise.t, z)
    x0 = guided_x0(prior, x_t, noise.t, noise.pair, noise.scale)
    g = weight(noise.weighting, signal) * (signal / (1 - signal)).sqrt() * (z - x0)
    return GuidanceGradient(clipped(g, noise.clip_rms), x0)


@torch.no_grad()
def inverted(prior: Prior, z: Latents, noise: NoiseSample, steps: int) -> Latents:
    """x_t that deterministic DDIM (Song et al. 2021, eq. 12) would bring back to `z`: its steps taken backwards.

    The noise between s and t > s is asked for at t, where the network is better conditioned. Unconditional, as the
    inversion of ISM (Liang et al. 2024).
    """
    plain = Scale(0.0, 0.0, noise.scale.sequential)
    x, here = z, torch.ones_like(_signal(prior, 0, z))
    for t in times(noise.t, steps)[::-1]:
        there = _signal(prior, t, z)
        eps = eps_from(guided_x0(prior, x, t, noise.pair, plain), x, there)
        x0 = (x - (1 - here).sqrt() * eps) / here.sqrt()
        x, here = add_noise(x0, eps, there), there
    return x


@torch.no_grad()
def denoised(prior: Prior, z: Latents, noise: NoiseSample, steps: int) -> Latents:
    """`z` noised to t and brought back by `steps` DDIM steps (SDEdit, Meng et al. 2022)."""
    x = add_noise(z.detach(), noise.eps, _signal(prior, noise.t, z))
    descending = times(noise.t, steps)
    for t, after in zip(descending, [*descending[1:], None], strict=True):
        x0 = guided_x0(prior, x, t, noise.pair, noise.scale)
        if after is None:
            break
        x = add_noise(x0, eps_from(x0, x, _signal(prior, t, z)), _signal(prior, after, z))
    return x0


def times(t: int, steps: int) -> list[int]:
    """At most `steps` distinct steps from t down, evenly spaced, the last one above 0 where there is room."""
    return list(dict.fromkeys(max(1, round(t * (steps - i) / steps)) for i in range(steps)))


def loss(z: Latents, g: Latents, weights: Float[Tensor, "B 1 h w"]) -> Float[Tensor, ""]:
    """Equation (1)."""
    target = (z - g).detach()
    return 0.5 * (weights * (z - target).square()).mean()


def wanted(images: Images, asked: Images, target: Images) -> Images:
    """Equation (3) without u; `asked` is the render that `target` was made of."""
    change = target - asked
    share = change.square() / (change.square() + CHANGE_SCALE**2)
    return share * (change * (target - images.detach()) > 0)


def pixel_gradient(images: Images, target: Images, weights: Images | Float[Tensor, "S S"]) -> Images:
    """dL/dx of equation (2)."""
    apart = images.detach() - target
    return weights * apart / (apart.square() + ROUNDING**2).sqrt() / apart.numel()


def resized(weights: Float[Tensor, "S S"], z: Latents) -> Float[Tensor, "1 1 h w"]:
    """Pixel weights averaged over what each latent covers."""
    return torch.nn.functional.adaptive_avg_pool2d(weights[None, None], (z.shape[2], z.shape[3])).to(z)


def clipped(g: Latents, rms: float) -> Latents:
    """g, shortened where its root mean square exceeds `rms`."""
    if rms == 0:
        return g
    return g * (rms / g.square().mean().sqrt().clamp_min(1e-12)).clamp(max=1)


def _signal(prior: Prior, t: int, like: Tensor) -> Signal:
    return prior.schedule.signal(torch.tensor([t]), like)
