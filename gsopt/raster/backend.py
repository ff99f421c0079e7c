"""The protocol of a rasterizer backend, and the image model.

A backend draws one camera at a time. `forward` returns a `RenderedFrame`, `backward` turns the gradient of a loss with
respect to that frame into gradients of the parameters. The training loop calls these two directly; `rasterize`
in `api.py` wraps the same two in autograd.

The image model, which the float64 reference defines and every backend follows:

* camera space t = viewmat · mean; a Gaussian is drawn when near_plane < t_z < far_plane.
* cov2d = J W Σ Wᵀ Jᵀ + eps2d·I with J the Jacobian of the pinhole projection at t, its t_x/t_z and t_y/t_z clamped to
  the view widened by 30 % of tan(fov/2) on either side (Zwicker 2001; Kerbl et al. 2023). A splat of
  det cov2d < 1e-12 px⁴ is not drawn; that takes an eps2d near 0.
* opacity o = sigmoid(logit), times sqrt(max(0, det cov / det cov2d)) when antialiased (Yu et al. 2024).
* alpha(p) = min(0.99, o · exp(-½ (p-mean2d)ᵀ cov2d⁻¹ (p-mean2d))), p the pixel center; below 1/255 it contributes
  nothing. At the clamp to 0.99 the gradient with respect to o and the exponent is zero: the true derivative.
* front to back by depth t_z, ties by index; a pixel takes no more once its transmittance T <= 1e-4.
* color = Σ T alpha c + T_final · background; alpha = 1 - T_final; depth = Σ T alpha t_z (not normalized).
* c = max(0, 0.5 + Σ sh_k Y_k(d)), d the unit vector from the camera center to the mean.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt import check
from gsopt.errors import NumericalError
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
DET_MIN = 1e-12


@dataclass(frozen=True)
class RasterSettings:
    """Settings of the image model."""

    sh_degree: int = 3
    """Highest band of the spherical harmonics that is evaluated (0-3)."""
    near_plane: float = 0.01
    """Gaussians nearer than this along the viewing axis are not drawn, scene units."""
    far_plane: float = 1e10
    """Gaussians farther than this are not drawn, scene units."""
    eps2d: float = 0.3
    """Variance added to every splat, px²."""
    antialiased: bool = False
    """Lower the opacity by what eps2d adds to a splat's area (Mip-Splatting's 2D filter)."""

    def __post_init__(self) -> None:
        check.within("sh_degree", self.sh_degree, 0, 3, "Bands 0 to 3 are supported.")
        check.at_least("near_plane", self.near_plane, 0.0, "Give a distance in scene units.")
        check.at_least("far_plane", self.far_plane, self.near_plane, "It must lie beyond near_plane.")
        check.at_least("eps2d", self.eps2d, 0.0, "Give a variance in px².")


@dataclass(frozen=True)
class RenderedFrame:
    """The image of one camera, and the state that `backward` needs."""

    colors: Float[Tensor, "H W 3"]
    """Composited on the background that was given, else premultiplied."""
    alphas: Float[Tensor, "H W"]
    depths: Float[Tensor, "H W"] | None
    """Σ T alpha z, not normalized, or None unless requested."""
    radii: Int[Tensor, "N 2"]
    """Half-extent of each splat's alpha >= 1/255 box in pixels, rounded up; 0 where it is not in the image."""
    context: object
    """Private to the backend."""


@dataclass(frozen=True)
class Gradients:
    """dLoss/dparameter for every Gaussian, and what density control reads."""

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, "N"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N K-1 3"] | None
    """Zero in bands above the rendered sh_degree; absent when `backward` had `bands=False`."""
    means2d: Float[Tensor, "N 2"]
    """dLoss/d(mean2d), 1/px: signed sum over pixels."""
    means2d_abs: Float[Tensor, "N 2"] | None
    """The same with absolute values summed over pixels (AbsGS, Ye et al. 2024), or None unless requested."""


@dataclass(frozen=True)
class Photometric:
    """(1 - lambda_dssim) · L1 + lambda_dssim · (1 - SSIM), averaged over pixels and channels."""

    l1: float
    ssim: float
    loss: float
    v_colors: Float[Tensor, "H W 3"]
    """dLoss/d(rendered)."""


@dataclass(frozen=True)
class AdamStep:
    """The numbers of one Adam step (Kingma & Ba 2015)."""

    lr: dict[str, float]
    """Rate of every parameter that takes the step."""
    steps: dict[str, int]
    """Its number, counted from 1."""
    beta1: float
    beta2: float
    eps: float


class Backend(Protocol):
    """A rasterizer, its photometric loss and its optimizer step: what runs once per training step."""

    name: str
    device: torch.device
    """Gaussians, gradients and images lie there; cameras and the background anywhere."""

    def forward(
        self,
        gaussians: Gaussians,
        camera: Cameras,
        settings: RasterSettings,
        background: Float[Tensor, "3"] | None = None,
        *,
        depth: bool = False,
    ) -> RenderedFrame:
        """Draw one camera (len(camera) == 1)."""
        ...

    def backward(
        self,
        frame: RenderedFrame,
        v_colors: Float[Tensor, "H W 3"],
        v_alphas: Float[Tensor, "H W"] | None = None,
        v_depths: Float[Tensor, "H W"] | None = None,
        *,
        absgrad: bool = False,
        bands: bool = True,
        into: Gradients | None = None,
    ) -> Gradients:
        """Gradients of the parameters that `forward` drew. A frame can be used once.

        `bands`: whether to write down the gradient of shN, three quarters of all numbers. `adam` does without where
        no other gradient is added.
        `into`: gradients that nobody needs any more; a backend may overwrite and return them, which spares it fresh
        memory. They serve only while the number of Gaussians stays the same.
        """
        ...

    def photometric(
        self, rendered: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lambda_dssim: float
    ) -> Photometric:
        """Fused L1 + D-SSIM and its gradient; SSIM 11x11, sigma 1.5, zero padding, C1 = 0.01², C2 = 0.03²."""
        ...

    def adam(
        self,
        gaussians: Gaussians,
        gradients: Gradients,
        exp_avg: Gaussians,
        exp_avg_sq: Gaussians,
        step: AdamStep,
        camera: Cameras,
        settings: RasterSettings,
    ) -> None:
        """One Adam step in place, for gradients of a frame that `camera` drew with `settings`.

        Without `gradients.shN` they must be of that frame alone: it is the outer product
        Y(direction of view) ⊗ gradients.sh0 / Y_0 then.
        """
        ...


@contextmanager
def enough_memory(count: int, width: int, height: int) -> Iterator[None]:
    """NumericalError where memory cannot hold an image of `count` Gaussians."""
    try:
        yield
    except (MemoryError, OverflowError, RuntimeError) as error:
        if type(error) is RuntimeError and not re.search("allocate|overflow", str(error)):  # torch has no other kind
            raise
        raise NumericalError(
            f"Drawing {count:,} Gaussians at {width}x{height} needs more memory than there is: {error}. Draw fewer or "
            "smaller splats, or a smaller image (`-r`)."
        ) from error
