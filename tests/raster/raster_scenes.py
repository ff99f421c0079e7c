"""Small random scenes for the rasterizer's tests, and which of their pixels rounding cannot tip."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from hypothesis import strategies
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.backend import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterSettings
from gsopt.raster.reference import project, raw_alphas, splat, transmittances


@dataclass(frozen=True)
class Case:
    """One camera before N Gaussians; every number is representable in float32, stored in float64."""

    gaussians: Gaussians
    camera: Cameras
    settings: RasterSettings
    background: Float[Tensor, "3"]
    seed: int


def make_case(
    seed: int,
    count: int = 12,
    width: int = 20,
    height: int = 16,
    settings: RasterSettings | None = None,
    sh_degree: int = 3,
) -> Case:
    """A cloud around the origin, seen from about five units away, with a few hard Gaussians among the plain ones."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    gaussians = Gaussians(
        means=normal(count, 3),
        quats=normal(count, 4),
        log_scales=-1.6 + 0.5 * normal(count, 3),
        logit_opacities=1.5 * normal(count),
        sh0=normal(count, 1, 3),
        shN=0.2 * normal(count, (sh_degree + 1) ** 2 - 1, 3),
    )
    _harden(gaussians, rng)
    eye = 5 * torch.nn.functional.normalize(normal(1, 3), dim=-1)
    viewmats = look_at(eye, 0.3 * normal(3), normal(3))
    Ks = intrinsics(0.9, width, height).float()[None]
    Ks[0, :2, 2] += normal(2)
    Ks[0, 1, 1] *= 1.1
    return Case(
        gaussians=gaussians.to(torch.float64),
        camera=Cameras(viewmats, Ks, width, height).to(torch.float64),
        settings=settings or RasterSettings(),
        background=torch.rand(3, generator=rng).to(torch.float64),
        seed=seed,
    )


def _harden(gaussians: Gaussians, rng: torch.Generator) -> None:
    """Make some rows hard: opaque, faint, a needle, a disc, far off the axis, a twin at the same place."""
    kinds = torch.randint(0, 12, (len(gaussians),), generator=rng).tolist()
    for row, kind in enumerate(kinds):
        if kind == 0:
            gaussians.logit_opacities[row] = 7.0
        elif kind == 1:
            gaussians.logit_opacities[row] = -7.0
        elif kind == 2:
            gaussians.log_scales[row, 0] = -4.0
        elif kind == 3:
            gaussians.log_scales[row, 1:] = -4.0
        elif kind == 4:
            gaussians.means[row] *= 3.0
        elif kind == 5 and row > 0:
            gaussians.means[row] = gaussians.means[row - 1]
        elif kind == 6:
            gaussians.quats[row] *= 100.0


@strategies.composite
def cases(draw: strategies.DrawFn) -> Case:
    """Hypothesis chooses size, settings and seed; torch's generator fills in the numbers."""
    settings = RasterSettings(
        sh_degree=draw(strategies.integers(0, 3)),
        antialiased=draw(strategies.booleans()),
        eps2d=draw(strategies.sampled_from([0.3, 1.0])),
        near_plane=draw(strategies.sampled_from([0.01, 4.5])),
    )
    return make_case(
        seed=draw(strategies.integers(0, 2**31 - 1)),
        count=draw(strategies.integers(1, 40)),
        width=draw(strategies.integers(1, 40)),
        height=draw(strategies.integers(1, 36)),
        settings=settings,
        sh_degree=draw(strategies.integers(0, 3)),
    )


def weights_like(case: Case) -> tuple[Tensor, Tensor, Tensor]:
    """Random v_colors, v_alphas, v_depths of the case's image size."""
    rng = torch.Generator().manual_seed(case.seed + 1)
    size = case.camera.height, case.camera.width
    v = torch.randn(*size, 5, generator=rng).to(torch.float64)
    return v[..., :3], v[..., 3], v[..., 4]


def with_parameter(case: Case, name: str, value: Tensor) -> Case:
    """The same case with one parameter replaced."""
    return replace(case, gaussians=replace(case.gaussians, **{name: value}))


def undecided_pixels(case: Case, margin: float) -> Bool[Tensor, "H W"]:
    """Pixels where some decision of the image model stands within `margin` (relative) of tipping."""
    size = case.camera.height, case.camera.width
    splats = splat(case.gaussians, case.camera, case.settings, torch.zeros(len(case.gaussians), 2, dtype=torch.float64))
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in size), indexing="ij")
    deltas = torch.stack([x, y], dim=-1).view(-1, 1, 2) - splats.means2d
    raw = raw_alphas(deltas, splats.conics, splats.opacities)
    T = torch.cat([t.view(len(raw), -1) for t in transmittances(raw.clamp_max(ALPHA_MAX) * (raw >= ALPHA_MIN))], dim=1)
    near_line = [_near(raw, ALPHA_MIN, margin), _near(raw, ALPHA_MAX, margin), _near(T, TRANSMITTANCE_MIN, 10 * margin)]
    return torch.stack([near.any(dim=1) for near in near_line]).any(dim=0).view(size)


def undecided_gaussians(case: Case, margin: float) -> bool:
    """Whether, for some Gaussian, culling, order, the Jacobian's clamp or a color's clamp stands within `margin`."""
    g, camera, settings = case.gaussians, case.camera, case.settings
    projection = project(g, camera, settings)
    points, z = projection.points, projection.points[:, 2]
    gaps = z.sort().values.diff()
    K = camera.Ks[0]
    size = K.new_tensor([camera.width, camera.height])
    focal, center = K.diagonal()[:2], K[:2, 2]
    slopes, reach = points[:, :2] / z[:, None], 0.15 * size / focal
    limits = torch.stack([(size - center) / focal + reach, -center / focal - reach])
    directions = torch.nn.functional.normalize(g.means - camera.centers[0], dim=-1)
    Y = sh.basis(directions, min(settings.sh_degree, g.sh_degree))
    colors = 0.5 + (Y[..., None] * torch.cat([g.sh0, g.shN], dim=1)[:, : Y.shape[-1]]).sum(dim=1)
    return bool(
        ((gaps > 0) & (gaps < margin)).any()
        or _near(z, settings.near_plane, margin).any()
        or _near(projection.opacities, ALPHA_MIN, margin).any()
        or ((slopes[:, None] - limits).abs() < margin).any()
        or (colors.abs() < margin).any()
    )


def _near(values: Tensor, line: float, margin: float) -> Tensor:
    return (values / line - 1).abs() < margin
