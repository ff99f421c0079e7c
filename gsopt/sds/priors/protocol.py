"""The interface of a diffusion prior: `denoise(x_t, t, conditions) -> x0_hat`.

Two kinds implement it. Stable Diffusion works on latents, takes text and image tokens and predicts eps or v; the
view-conditioned prior works on pixels, takes the current render and posed reference views, and predicts x0. Each reads
from a `Condition` the fields it supports. Policies, classifier-free guidance and training use x0 only.
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
    """Input views as references of a view-conditioned prior."""

    images: Float[Tensor, "K 3 S S"]
    """0..1, on the background."""
    alphas: Float[Tensor, "K 1 S S"]
    """Alphas; 1 for a view without alpha."""
    cameras: Cameras
    """K of them, S x S px."""
    depths: Float[Tensor, "K S S"] | None = None
    """Expected z of the current Gaussians in these views, for priors that want references aligned."""


@dataclass(frozen=True)
class Condition:
    """Conditions on one image of a batch; `None` = absent (in training: dropped out)."""

    tokens: Float[Tensor, "L D"] | None = None
    """Tokens for cross-attention: hidden states of the prompt, then image tokens."""
    class_embedding: Float[Tensor, "E"] | None = None
    """SD 2.1-unCLIP's image embedding with its noise level."""
    render: Float[Tensor, "4 S S"] | None = None
    """The render to be improved, color on the background and alpha, aligned with the image pixel by pixel."""
    depth: Float[Tensor, "S S"] | None = None
    """Expected z of the render, 0 on empty pixels."""
    uncertainty: Float[Tensor, "S S"] | None = None
    """Uncertainty of each pixel of the render, given the input views, 0 to 1."""
    camera: Cameras | None = None
    """The camera of the image, S x S px."""
    references: References | None = None


class Encoder(Protocol):
    """Encodes text and images as tokens of a prior. Used once, then released."""

    name: str

    def texts(self, texts: Sequence[str]) -> Float[Tensor, "n L D"]:
        """Hidden states of every text, padded to one length."""
        ...

    def length(self, text: str) -> int:
        """Tokens of a text, begin and end included."""
        ...

    def unknown_words(self, text: str) -> list[str]:
        """Words of a text outside its vocabulary, as far as it can determine."""
        ...

    @property
    def max_tokens(self) -> int:
        """Token limit; longer texts are truncated."""
        ...

    def images(self, images: Images) -> Float[Tensor, "n E"] | None:
        """Returns CLIP image embeddings, not normalized; without an image encoder `None`."""
        ...

    def alignment(self, texts: Sequence[str], images: Images) -> Float[Tensor, "n m"] | None:
        """Returns the cosine of every text with every image in CLIP's joint space; without one `None`."""
        ...


class Prior(Protocol):
    """A diffusion model of images."""

    name: str
    """Displayed name of the model, with its prediction type."""
    size: int
    """Side of its square images, px."""
    schedule: NoiseSchedule
    x0_limit: float | None
    """Bound of |x0| (1 for pixels in [-1, 1]), `None` for latents."""
    class_embedding_width: int | None
    """E of `Condition.class_embedding` (half the input of unCLIP's network), or `None`."""
    aligned: bool
    """True if it uses the render, its depth and the references, which are not computed otherwise."""

    def encode(self, images: Images) -> Latents:
        """Encodes into the model's space, float32. Differentiable."""
        ...

    def decode(self, x0: Latents) -> Images:
        """Decodes to pixels, no gradient."""
        ...

    def denoise(self, x_t: Latents, t: Int[Tensor, "B"], conditions: Sequence[Condition]) -> Latents:
        """Calls the network with one condition per row; returns its estimate of x0, float32, no gradient."""
        ...

    def encoder(self) -> Encoder | None:
        """Loads the encoder of text and images, or returns `None` for a prior without one."""
        ...


@dataclass(frozen=True)
class Pair:
    """The two halves of classifier-free guidance."""

    positive: Condition
    negative: Condition
    """Condition without prompt and references, or with the negative prompt, but with the render and the camera."""


@dataclass(frozen=True)
class Scale:
    """Parameters of combining the two halves."""

    guidance: float = 1.0
    rescale: float = 0.0
    sequential: bool = False
    """Two calls of one row instead of one call of two: half the activations."""


@torch.no_grad()
def guided_x0(prior: Prior, x_t: Latents, t: int, pair: Pair, scale: Scale) -> Latents:
    """Classifier-free guidance (Ho & Salimans 2022) on the estimate of x0: x_u + s (x_c - x_u).

    At fixed x_t and t, eps and v are affine in x0, so this is eps_u + s (eps_c - eps_u) exactly. s = 1 and s = 0 call
    the model with one row. Raises NumericalError when the prediction is not finite.
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
    """Lin et al. 2024, eq. 15 and 16, on x0 and about its mean: otherwise a white background would darken."""
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
        f"The prior {prior.name} predicted {x0[tuple(index)].item()} at index {index} for step t={t}. "
        "Half precision is the usual cause: choose --guidance.dtype float32 or bfloat16."
    )
