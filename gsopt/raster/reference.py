"""The rasterizer in plain torch: dense, slow, and the oracle every other backend is compared with.

It computes in the dtype of the Gaussians (float64 for an oracle) and differentiates by autograd, so that nothing
here shares a derivation with the compiled kernels. Every pixel meets every visible Gaussian: use it for small scenes.
The image model stands in backend.py; equation numbers refer to docs/math.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsopt.errors import UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry import quats as quaternions
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import (
    ALPHA_MAX,
    ALPHA_MIN,
    DET_MIN,
    TRANSMITTANCE_MIN,
    AdamStep,
    Gradients,
    Photometric,
    RasterSettings,
    RenderedFrame,
)
from gsopt.raster.ssim import photometric_terms

# How far beyond the image the Jacobian is still evaluated where the Gaussian is, in units of tan(fov/2).
VIEW_MARGIN = 0.3
# Pixel-Gaussian pairs held at once; the rest is recomputed in the backward pass.
PAIRS_PER_CHUNK = 1 << 20
# The largest radius that is told apart, px: keeps a splat of astronomical size within int32.
RADIUS_MAX = 1 << 30


@dataclass(frozen=True)
class Splats:
    """The M Gaussians that touch the image, front to back."""

    rows: Int[Tensor, " M"]
    """Index of the Gaussian."""
    means2d: Float[Tensor, "M 2"]
    conics: Float[Tensor, "M 3"]
    """Inverse of cov2d: xx, xy, yy, px^-2."""
    opacities: Float[Tensor, " M"]
    colors: Float[Tensor, "M 3"]
    depths: Float[Tensor, " M"]
    radii: Int[Tensor, "N 2"]
    """Those of all N Gaussians, in their own order."""


@dataclass
class Tape:
    """The autograd graph of one frame, from leaves to image."""

    leaves: Gaussians
    offsets2d: Float[Tensor, "N 2"]
    """Zeros added to mean2d, so that autograd tells dLoss/dmean2d."""
    splats: Splats
    background: Float[Tensor, "3"]
    colors: Float[Tensor, "H W 3"]
    alphas: Float[Tensor, "H W"]
    depths: Float[Tensor, "H W"]
    used: bool = field(default=False)


def jacobians(points: Float[Tensor, "M 3"], K: Float[Tensor, "3 3"], width: int, height: int) -> Float[Tensor, "M 2 3"]:
    """d(pixel)/d(camera-space point), eq. 2, with x/z and y/z clamped to the widened view."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = points.unbind(-1)
    margin_x, margin_y = VIEW_MARGIN * 0.5 * width / fx, VIEW_MARGIN * 0.5 * height / fy
    u = torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
    v = torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    rows = [torch.stack([fx / z, zero, -fx * u / z], dim=-1), torch.stack([zero, fy / z, -fy * v / z], dim=-1)]
    return torch.stack(rows, dim=-2)


def covariances(quats: Float[Tensor, "M 4"], log_scales: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3 3"]:
    """Σ = R S Sᵀ Rᵀ in world space, eq. 3."""
    RS = quaternions.rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return RS @ RS.transpose(-1, -2)


def determinants(matrices: Float[Tensor, "M 2 2"]) -> Float[Tensor, " M"]:
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]


def antialias_factor(cov: Float[Tensor, "M 2 2"], cov2d: Float[Tensor, "M 2 2"]) -> Float[Tensor, " M"]:
    """sqrt(max(0, det cov / det cov2d)), eq. 5; zero with zero gradient where the splat has no area of its own."""
    ratio = determinants(cov) / determinants(cov2d)
    positive = ratio > 0
    return torch.where(positive, torch.where(positive, ratio, 1).sqrt(), 0)


@dataclass(frozen=True)
class Projection:
    """M Gaussians as the camera sees them, before anything is culled."""

    points: Float[Tensor, "M 3"]
    """Camera space."""
    means2d: Float[Tensor, "M 2"]
    cov2d: Float[Tensor, "M 2 2"]
    opacities: Float[Tensor, " M"]


def project(gaussians: Gaussians, camera: Cameras, settings: RasterSettings) -> Projection:
    """Eqs. 1-5 for every Gaussian; meaningless, but harmless, for those behind the camera."""
    viewmat, K = camera.viewmats[0], camera.Ks[0]
    R = viewmat[:3, :3]
    points = gaussians.means @ R.T + viewmat[:3, 3]
    T = jacobians(points, K, camera.width, camera.height) @ R
    cov = T @ covariances(gaussians.quats, gaussians.log_scales) @ T.transpose(-1, -2)
    cov2d = cov + settings.eps2d * torch.eye(2, dtype=cov.dtype, device=cov.device)
    # The logarithm first: its derivative 1 - sigmoid keeps its digits where the sigmoid rounds to 1.
    opacities = torch.nn.functional.logsigmoid(gaussians.logit_opacities).exp()
    return Projection(
        points=points,
        means2d=points[:, :2] / points[:, 2:] * K.diagonal()[:2] + K[:2, 2],
        cov2d=cov2d,
        opacities=opacities * antialias_factor(cov, cov2d) if settings.antialiased else opacities,
    )


def extents(projection: Projection) -> Float[Tensor, "M 2"]:
    """Half-sides in px of the box where alpha >= 1/255, eq. 6; NaN where opacity itself is below."""
    variances = projection.cov2d.diagonal(dim1=-2, dim2=-1)
    return (2 * torch.log(projection.opacities / ALPHA_MIN)[:, None] * variances).sqrt()


@torch.no_grad()
def visible_rows(
    gaussians: Gaussians, camera: Cameras, settings: RasterSettings
) -> tuple[Int[Tensor, " M"], Int[Tensor, "N 2"]]:
    """The Gaussians that touch the image, front to back with ties by index, and the radii of all.

    Whatever is NaN on the way (opacity below 1/255, overflowing scales, depth zero) compares as false and is culled.
    """
    projection = project(gaussians, camera, settings)
    z, means2d, reach = projection.points[:, 2], projection.means2d, extents(projection)
    size = means2d.new_tensor([camera.width, camera.height])
    visible = ((means2d + reach > 0) & (means2d - reach < size)).all(dim=-1)
    visible &= (z > settings.near_plane) & (z < settings.far_plane) & (determinants(projection.cov2d) >= DET_MIN)
    radii = torch.zeros(len(gaussians), 2, dtype=torch.int32, device=z.device)
    radii[visible] = reach[visible].ceil().clamp_max(RADIUS_MAX).to(torch.int32)
    rows = torch.nonzero(visible)[:, 0]
    return rows[torch.argsort(z[rows], stable=True)], radii


def splat(gaussians: Gaussians, camera: Cameras, settings: RasterSettings, offsets2d: Float[Tensor, "N 2"]) -> Splats:
    """Gaussians to splats. Only the visible ones enter the autograd graph, so that no culled infinity reaches it."""
    rows, radii = visible_rows(gaussians, camera, settings)
    g = gaussians.select(rows)
    projection = project(g, camera, settings)
    directions = torch.nn.functional.normalize(g.means - camera.centers[0], dim=-1)
    return Splats(
        rows=rows,
        means2d=projection.means2d + offsets2d[rows],
        conics=_conics(projection.cov2d),
        opacities=projection.opacities,
        colors=sh.evaluate(g.sh0, g.shN, directions, settings.sh_degree),
        depths=projection.points[:, 2],
        radii=radii,
    )


def _conics(cov2d: Float[Tensor, "M 2 2"]) -> Float[Tensor, "M 3"]:
    det = determinants(cov2d)
    return torch.stack([cov2d[:, 1, 1] / det, -cov2d[:, 0, 1] / det, cov2d[:, 0, 0] / det], dim=-1)


def smooth_threshold(raw: Float[Tensor, "P M"]) -> Float[Tensor, "P M"]:
    """Alpha with a C1 ramp over [1/255, 2/255] in the place of the hard threshold, so that differences are fair."""
    t = ((raw - ALPHA_MIN) / ALPHA_MIN).clamp(0, 1)
    return raw.clamp_max(ALPHA_MAX) * t * t * (3 - 2 * t)


def hard_threshold(raw: Float[Tensor, "P M"]) -> Float[Tensor, "P M"]:
    """min(0.99, raw), and zero below 1/255. The clamp's derivative is zero above 0.99."""
    return torch.where(raw >= ALPHA_MIN, raw.clamp_max(ALPHA_MAX), 0)


def raw_alphas(
    deltas: Float[Tensor, "P M 2"], conics: Float[Tensor, "M 3"], opacities: Float[Tensor, " M"]
) -> Float[Tensor, "P M"]:
    """o · exp(-½ dᵀ conic d), d = pixel - mean2d, eq. 7."""
    dx, dy = deltas.unbind(-1)
    a, b, c = conics.unbind(-1)
    return opacities * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))


def transmittances(alphas: Float[Tensor, "P M"]) -> tuple[Float[Tensor, "P M"], Float[Tensor, " P"]]:
    """T before each Gaussian, and T behind the last."""
    through = torch.cumprod(1 - alphas, dim=1)
    ahead = torch.cat([through.new_ones(len(through), 1), through], dim=1)
    return ahead[:, :-1], ahead[:, -1]


class ReferenceBackend:
    """The oracle. `smooth_cutoff` replaces the threshold at 1/255 by a C1 ramp: only for gradient tests."""

    name: str = "reference"
    device = torch.device("cpu")

    def __init__(self, smooth_cutoff: bool = False) -> None:
        self.smooth_cutoff = smooth_cutoff

    def forward(
        self,
        gaussians: Gaussians,
        camera: Cameras,
        settings: RasterSettings,
        background: Float[Tensor, "3"] | None = None,
        *,
        depth: bool = False,
    ) -> RenderedFrame:
        """Draw one camera in the dtype of the Gaussians."""
        if len(camera) != 1:
            raise UsageError(f"A backend draws one camera at a time, got {len(camera)}. Call it once per camera.")
        camera = camera.to(gaussians.means.dtype).to(gaussians.means.device)
        behind = gaussians.means.new_zeros(3) if background is None else background.detach().to(gaussians.means)
        with torch.enable_grad():
            leaves = Gaussians(**{name: tensor.detach().clone().requires_grad_() for name, tensor in gaussians.items()})
            offsets2d = gaussians.means.new_zeros(len(gaussians), 2).requires_grad_()
            splats = splat(leaves, camera, settings, offsets2d)
            tape = Tape(leaves, offsets2d, splats, behind, *self._image(splats, behind, camera))
        return RenderedFrame(
            colors=tape.colors.detach(),
            alphas=tape.alphas.detach(),
            depths=tape.depths.detach() if depth else None,
            radii=splats.radii,
            context=tape,
        )

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
        """Vector-Jacobian product by autograd; `into` is left alone."""
        tape = frame.context
        if not isinstance(tape, Tape) or tape.used:
            raise UsageError("This frame's backward pass already ran, or another backend drew it. Draw it again.")
        tape.used = True
        v = (
            v_colors.to(tape.colors),
            torch.zeros_like(tape.alphas) if v_alphas is None else v_alphas.to(tape.alphas),
            torch.zeros_like(tape.depths) if v_depths is None else v_depths.to(tape.depths),
        )
        means2d_abs = self._means2d_abs(tape, v) if absgrad else None
        inputs = [*(tensor for _, tensor in tape.leaves.items()), tape.offsets2d]
        image = (tape.colors, tape.alphas, tape.depths)
        *parameters, means2d = torch.autograd.grad(image, inputs, v, allow_unused=True, materialize_grads=True)
        named: dict[str, Any] = dict(zip(PARAMETERS, parameters, strict=True))
        if not bands:
            named["shN"] = None
        return Gradients(**named, means2d=means2d, means2d_abs=means2d_abs)

    def photometric(
        self, rendered: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lambda_dssim: float
    ) -> Photometric:
        """L1 + D-SSIM and its gradient, by autograd."""
        with torch.enable_grad():
            x = rendered.detach().clone().requires_grad_()
            l1, similarity, loss = photometric_terms(x, target.to(x), lambda_dssim)
            (v_colors,) = torch.autograd.grad(loss, x)
        return Photometric(l1.item(), similarity.item(), loss.item(), v_colors.contiguous())

    @torch.no_grad()
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
        """One Adam step in place (Kingma & Ba 2015, algorithm 1)."""
        grads = {name: getattr(gradients, name) for name in step.lr}
        if "shN" in grads and grads["shN"] is None:
            degree = min(settings.sh_degree, gaussians.sh_degree)
            grads["shN"] = _bands_gradient(gaussians, gradients.sh0, camera, degree)
        for name, grad in grads.items():
            m, v = getattr(exp_avg, name), getattr(exp_avg_sq, name)
            m.mul_(step.beta1).add_(grad, alpha=1 - step.beta1)
            v.mul_(step.beta2).addcmul_(grad, grad, value=1 - step.beta2)
            m_hat = m / (1 - step.beta1 ** step.steps[name])
            v_hat = v / (1 - step.beta2 ** step.steps[name])
            getattr(gaussians, name).sub_(step.lr[name] * m_hat / (v_hat.sqrt() + step.eps))

    def _image(
        self, splats: Splats, background: Float[Tensor, "3"], camera: Cameras
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"], Float[Tensor, "H W"]]:
        """Composite every pixel; what a chunk computes on the way is thrown away and made again when differentiated."""

        def composite(pixels: Float[Tensor, "P 2"]) -> tuple[Tensor, Tensor, Tensor]:
            return self._composite(pixels[:, None] - splats.means2d, splats, background)

        chunks = [
            checkpoint(composite, pixels, use_reentrant=False, preserve_rng_state=False)
            for pixels in _pixel_chunks(splats, camera.height, camera.width)
        ]
        colors, alphas, depths = (torch.cat(parts) for parts in zip(*chunks, strict=True))
        size = (camera.height, camera.width)
        return colors.view(*size, 3), alphas.view(*size), depths.view(*size)

    def _composite(
        self, deltas: Float[Tensor, "P M 2"], splats: Splats, background: Float[Tensor, "3"]
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, " P"], Float[Tensor, " P"]]:
        """Front to back over the M splats, eq. 8: colors on the background, alpha, depth."""
        threshold = smooth_threshold if self.smooth_cutoff else hard_threshold
        alphas = threshold(raw_alphas(deltas, splats.conics, splats.opacities))
        # T only falls, so "T before this one is still above the stop" marks exactly what the pixel takes.
        taken = transmittances(alphas.detach())[0] > TRANSMITTANCE_MIN
        alphas = torch.where(taken, alphas, 0)
        T, T_final = transmittances(alphas)
        weights = T * alphas
        return weights @ splats.colors + T_final[:, None] * background, 1 - T_final, weights @ splats.depths

    def _means2d_abs(self, tape: Tape, v: tuple[Tensor, Tensor, Tensor]) -> Float[Tensor, "N 2"]:
        """Σ over pixels of |dLoss/dmean2d through that pixel|: the gradient of each pixel's own deltas, eq. 11."""
        height, width = tape.alphas.shape
        total = torch.zeros_like(tape.splats.means2d)
        begin = 0
        for pixels in _pixel_chunks(tape.splats, height, width):
            end = begin + len(pixels)
            with torch.enable_grad():
                deltas = (pixels[:, None] - tape.splats.means2d.detach()).requires_grad_()
                image = self._composite(deltas, tape.splats, tape.background)
                v_chunk = [gradient.flatten(0, 1)[begin:end] for gradient in v]
                (v_deltas,) = torch.autograd.grad(image, deltas, v_chunk)
            total += v_deltas.abs().sum(dim=0)
            begin = end
        return torch.zeros_like(tape.offsets2d).index_add(0, tape.splats.rows, total).detach()


def _pixel_chunks(splats: Splats, height: int, width: int) -> Iterator[Float[Tensor, "P 2"]]:
    """Pixel centers (x, y) in row order, as many at a time as memory allows."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centers = (torch.stack([x, y], dim=-1).view(-1, 2) + 0.5).to(splats.means2d)
    yield from centers.split(max(1, PAIRS_PER_CHUNK // max(1, len(splats.rows))))


def _bands_gradient(
    gaussians: Gaussians, v_sh0: Float[Tensor, "N 1 3"], camera: Cameras, sh_degree: int
) -> Float[Tensor, "N K-1 3"]:
    """Gradient of shN from that of sh0: a color is linear in both."""
    directions = torch.nn.functional.normalize(gaussians.means - camera.centers[0].to(gaussians.means), dim=-1)
    drawn = sh.basis(directions, sh_degree)[:, 1:, None] * v_sh0 / sh.C0
    rest = gaussians.shN.shape[1] - drawn.shape[1]
    return torch.nn.functional.pad(drawn, (0, 0, 0, rest))
