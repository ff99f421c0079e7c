"""What a diffusion prior is to the rest of gsopt: `denoise(x_t, t, conditions) -> x0_hat`.

Two kinds stand behind it. Stable Diffusion works on latents, takes text and image tokens and predicts eps or v; the
view-conditioned prior works on pixels, takes the current render and posed reference views, and predicts x0. Each reads
from a `Condition` what it knows and ignores the rest. Policies, classifier-free guidance and training see x0 only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.errors import NumericalError
from gsopt.geometry.cameras import Cameras
from gsopt.sds.noise import Latents, NoiseSchedule

Images = Float[Tensor, "B 3 S S"]
"""Square, 0..1, sRGB-coded, on the run's background."""


@dataclass(frozen=True)
class References:
    """Input views as a view-conditioned prior sees them."""

    images: Float[Tensor, "K 3 S S"]
    """0..1, on the background."""
    alphas: Float[Tensor, "K 1 S S"]
    """1 where the view has no alpha."""
    cameras: Cameras
    """K of them, S x S px."""
    depths: Float[Tensor, "K S S"] | None = None
    """Expected z of the current Gaussians in these views, for priors that want references aligned."""


@dataclass(frozen=True)
class Condition:
    """What one row of a call may know about its image. None: not known (in training: dropped out)."""

    tokens: Float[Tensor, "L D"] | None = None
    """For cross-attention: hidden states of the prompt, then image tokens."""
    class_embedding: Float[Tensor, "E"] | None = None
    """SD 2.1-unCLIP's image embedding with its noise level."""
    render: Float[Tensor, "4 S S"] | None = None
    """The render to be improved, color on the background and alpha, aligned with the image pixel by pixel."""
    depth: Float[Tensor, "S S"] | None = None
    """Expected z of the render, 0 where there is nothing."""
    uncertainty: Float[Tensor, "S S"] | None = None
    """How free the input views left each pixel of the render, 0 to 1."""
    camera: Cameras | None = None
    """The camera of the image, S x S px."""
    references: References | None = None


class Encoder(Protocol):
    """Turns words and pictures into what a prior attends to. Used once, then dropped."""

    name: str

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "n L D"]:
        """Hidden states of every text, padded to one length."""
        ...

    def length(self, text: str) -> int:
        """Tokens of a text, begin and end included."""
        ...

    def unknown_words(self, text: str) -> list[str]:
        """Words of a text that it never met, as far as it can tell."""
        ...

    @property
    def longest(self) -> int:
        """Tokens that are read; what a text has beyond is cut off."""
        ...

    def images(self, images: Images) -> Float[Tensor, "n E"] | None:
        """CLIP image embeddings, not normalised; None where there is no image encoder."""
        ...

    def alignment(self, texts: Sequence[str], images: Images) -> Float[Tensor, "n m"] | None:
        """Cosine of every text with every image in CLIP's joint space; None where there is no such space."""
        ...


class Prior(Protocol):
    """A diffusion model that judges images."""

    name: str
    """For people: what was loaded, with its prediction type."""
    size: int
    """Side of the square images it was made for, px."""
    schedule: NoiseSchedule
    x0_limit: float | None
    """Largest |x0| there is (1 for pixels in [-1, 1]); None for latents."""
    class_embedding_width: int | None
    """E of `Condition.class_embedding` (half of what unCLIP's network takes); None where it takes none."""
    aligned: bool
    """Whether it looks at the render, its depth and the references; else these are not made for it."""

    def encode(self, images: Images) -> Latents:
        """Into the model's space, float32. Differentiable."""
        ...

    def decode(self, x0: Latents) -> Images:
        """Back to pixels, no gradient."""
        ...

    def denoise(self, x_t: Latents, t: Int[Tensor, "B"], conditions: Sequence[Condition]) -> Latents:
        """One call of the network, one condition per row: its estimate of x0, float32, no gradient."""
        ...

    def encoder(self) -> Encoder | None:
        """Loads what turns words and pictures into tokens; None for a prior that takes none."""
        ...


@dataclass(frozen=True)
class Pair:
    """The two halves of classifier-free guidance."""

    positive: Condition
    negative: Condition
    """Without the prompt and the references, or with the negative prompt; the render and the camera stay."""


@dataclass(frozen=True)
class Scale:
    """How the halves are put together."""

    guidance: float = 1.0
    rescale: float = 0.0
    sequential: bool = False
    """Two calls of one row instead of one call of two: half the activations."""


@torch.no_grad()
def guided_x0(prior: Prior, x_t: Latents, t: int, pair: Pair, scale: Scale) -> Latents:
    """Classifier-free guidance (Ho & Salimans 2022) on the estimate of x0: x_u + s (x_c - x_u).

    At fixed x_t and t, eps and v are affine in x0, so this is eps_u + s (eps_c - eps_u) exactly. s = 1 and s = 0 call
    the model with one row. Raises NumericalError when the model answers with anything that is not finite.
    """
    if scale.guidance in (0.0, 1.0):
        only = pair.positive if scale.guidance == 1 else pair.negative
        x0 = _finite(prior, prior.denoise(x_t, torch.tensor([t]), [only]), t)
    else:
        conditional, unconditional = _halves(prior, x_t, t, pair, scale.sequential)
        x0 = unconditional + scale.guidance * (conditional - unconditional)
        x0 = _rescaled(x0, conditional, scale.rescale)
    return x0 if prior.x0_limit is None else x0.clamp(-prior.x0_limit, prior.x0_limit)


def _halves(prior: Prior, x_t: Latents, t: int, pair: Pair, sequential: bool) -> tuple[Latents, Latents]:
    if sequential:
        halves = [prior.denoise(x_t, torch.tensor([t]), [condition]) for condition in (pair.positive, pair.negative)]
        both = torch.cat(halves)
    else:
        both = prior.denoise(x_t.repeat(2, 1, 1, 1), torch.tensor([t, t]), [pair.positive, pair.negative])
    conditional, unconditional = _finite(prior, both, t).chunk(2)
    return conditional, unconditional


def _rescaled(x0: Latents, conditional: Latents, share: float) -> Latents:
    """Lin et al. 2024, eq. 15 and 16, on x0 and about its mean: without the latter a white background would darken."""
    if share == 0:
        return x0
    axes = (1, 2, 3)
    mean = x0.mean(axes, keepdim=True)
    ratio = conditional.std(axes, keepdim=True) / x0.std(axes, keepdim=True).clamp_min(1e-8)
    return share * (mean + (x0 - mean) * ratio) + (1 - share) * x0


def _finite(prior: Prior, x0: Latents, t: int) -> Latents:
    if bool(torch.isfinite(x0).all()):
        return x0
    index = torch.nonzero(~torch.isfinite(x0))[0].tolist()
    raise NumericalError(
        f"The prior {prior.name} answered {x0[tuple(index)].item()} at index {index} for step t={t}. "
        "Half precision is the usual cause: choose --guidance.dtype float32 or bfloat16."
    )
