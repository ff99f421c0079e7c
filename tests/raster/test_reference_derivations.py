"""The gradients that docs/math.md derives (eqs. 9-16, 18, 20, 21), written out in torch, equal those of autograd."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from raster_scenes import Case, make_case, weights_like
from torch import Tensor

from gsopt.geometry import quats as quaternions
from gsopt.geometry import sh
from gsopt.raster.backend import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterSettings
from gsopt.raster.reference import ReferenceBackend, Splats, jacobians, project, raw_alphas, splat
from gsopt.raster.ssim import C1, C2, blur, ssim_map

BACKEND = ReferenceBackend()


@dataclass
class SplatGradients:
    """dLoss/d(what compositing saw), one row per visible splat."""

    log_opacity: Tensor
    mean2d: Tensor
    mean2d_abs: Tensor
    conic: Tensor
    color: Tensor
    depth: Tensor


def compositing_gradient(case: Case, splats: Splats, v: tuple[Tensor, Tensor, Tensor]) -> SplatGradients:
    """Eqs. 9-11, back to front, all pixels at once."""
    height, width = case.camera.height, case.camera.width
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    d = torch.stack([x, y], dim=-1).view(-1, 1, 2) - splats.means2d
    raw = raw_alphas(d, splats.conics, splats.opacities)
    g, g_alpha, g_depth = v[0].flatten(0, 1), v[1].flatten(), v[2].flatten()
    T, taken, alphas = torch.ones(len(raw), dtype=raw.dtype), [], []
    for i in range(raw.shape[1]):
        taken.append((raw[:, i] >= ALPHA_MIN) & (T > TRANSMITTANCE_MIN))
        alphas.append(torch.where(taken[i], raw[:, i].clamp_max(ALPHA_MAX), 0))
        T = T * (1 - alphas[i])
    behind = g @ case.background - g_alpha
    s, w = torch.zeros_like(raw), torch.zeros_like(raw)
    for i in reversed(range(raw.shape[1])):
        T = T / (1 - alphas[i])
        q = g @ splats.colors[i] + g_depth * splats.depths[i]
        w[:, i] = T * alphas[i]
        s[:, i] = torch.where(raw[:, i] < ALPHA_MAX, w[:, i] * (q - behind), 0)
        behind = behind + alphas[i] * (q - behind)
    a, b, c = splats.conics.unbind(-1)
    pull = s[..., None] * torch.stack([a * d[..., 0] + b * d[..., 1], b * d[..., 0] + c * d[..., 1]], dim=-1)
    moments = [-0.5 * s * d[..., 0] ** 2, -s * d[..., 0] * d[..., 1], -0.5 * s * d[..., 1] ** 2]
    return SplatGradients(
        log_opacity=s.sum(0),
        mean2d=pull.sum(0),
        mean2d_abs=pull.abs().sum(0),
        conic=torch.stack(moments, dim=-1).sum(0),
        color=w.T @ g,
        depth=w.T @ g_depth,
    )


def covariance_gradient(cov2d: Tensor, v: SplatGradients, eps2d: float, antialiased: bool) -> Tensor:
    """Eqs. 12 and 13: the symmetric G of one splat."""
    X, Y, Z = cov2d[0, 0], cov2d[0, 1], cov2d[1, 1]
    D = X * Z - Y * Y
    v_a, v_b, v_c = v.conic
    v_D = -(Z * v_a - Y * v_b + X * v_c) / D**2
    v_X, v_Z, v_Y = v_c / D + v_D * Z, v_a / D + v_D * X, -v_b / D - 2 * v_D * Y
    if antialiased:
        X0, Z0 = X - eps2d, Z - eps2d
        D0, h = X0 * Z0 - Y * Y, 0.5 * v.log_opacity
        v_X, v_Z, v_Y = v_X + h * (Z0 / D0 - Z / D), v_Z + h * (X0 / D0 - X / D), v_Y - 2 * h * (Y / D0 - Y / D)
    return torch.stack([v_X, v_Y / 2, v_Y / 2, v_Z]).view(2, 2)


def quaternion_gradient(quat: Tensor, r: Tensor) -> Tensor:
    """Eq. 15."""
    unit = quaternions.normalize(quat)
    w, x, y, z = unit
    antisymmetric = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    v_unit = 2 * torch.stack(
        [
            x * antisymmetric[0] + y * antisymmetric[1] + z * antisymmetric[2],
            y * xy + z * xz + w * antisymmetric[0] - 2 * x * (r[1, 1] + r[2, 2]),
            x * xy + z * yz + w * antisymmetric[1] - 2 * y * (r[0, 0] + r[2, 2]),
            x * xz + y * yz + w * antisymmetric[2] - 2 * z * (r[0, 0] + r[1, 1]),
        ]
    )
    return (v_unit - unit * (unit @ v_unit)) / torch.linalg.vector_norm(quat)


def point_gradient(t: Tensor, T: Tensor, v_T: Tensor, v: SplatGradients, case: Case) -> Tensor:
    """Eq. 16 without its last line: dLoss/dt. The clamp is read off T itself."""
    camera = case.camera
    W, K = camera.viewmats[0, :3, :3], camera.Ks[0]
    focal, slopes = K.diagonal()[:2], t[:2] / t[2]
    J = jacobians(t[None], K, camera.width, camera.height)[0]
    clamped = -torch.stack([J[0, 2], J[1, 2]]) * t[2] / focal
    inside = (clamped - slopes).abs() < 1e-12
    v_slopes = focal * v.mean2d - torch.where(inside, (focal / t[2]) * (v_T @ W[2]), 0)
    v_z = v.depth - ((v_T * T).sum() + slopes @ v_slopes) / t[2]
    return torch.cat([v_slopes / t[2], v_z[None]])


def color_gradients(case: Case, row: int, v_color: Tensor) -> tuple[Tensor, Tensor]:
    """Eq. 18: (v_sh [K,3], the part of v_mean through the viewing direction)."""
    g, degree = case.gaussians, case.settings.sh_degree
    offset = g.means[row] - case.camera.centers[0]
    distance = torch.linalg.vector_norm(offset)
    e = offset / distance
    Y = sh.basis(e, degree)
    coefficients = torch.cat([g.sh0[row], g.shN[row]])[: len(Y)]
    v_color = torch.where(0.5 + Y @ coefficients > 0, v_color, 0)
    slopes = torch.autograd.functional.jacobian(lambda direction: sh.basis(direction, degree), e)
    v_e = (coefficients @ v_color) @ slopes
    return Y[:, None] * v_color, (v_e - e * (e @ v_e)) / distance


CASES = [
    make_case(41, count=16, width=14, height=11),
    make_case(42, count=16, width=14, height=11, settings=RasterSettings(antialiased=True, sh_degree=2)),
    make_case(206, count=16, width=6, height=6),
]


@pytest.mark.parametrize("case", CASES, ids=["plain", "antialiased", "off axis"])
def test_the_derived_gradients_are_those_of_autograd(case: Case) -> None:
    g, camera, setting = case.gaussians, case.camera, case.settings
    v = weights_like(case)
    frame = BACKEND.forward(g, camera, setting, case.background, depth=True)
    truth = BACKEND.backward(frame, *v, absgrad=True)
    splats = splat(g, camera, setting, torch.zeros(len(g), 2, dtype=torch.float64))
    seen = compositing_gradient(case, splats, v)
    projection, W = project(g, camera, setting), camera.viewmats[0, :3, :3]
    assert len(splats.rows) >= 8
    for slot, row in enumerate(splats.rows.tolist()):
        own = SplatGradients(**{name: tensor[slot] for name, tensor in vars(seen).items()})
        T = jacobians(projection.points[row][None], camera.Ks[0], camera.width, camera.height)[0] @ W
        R, scales = quaternions.rotation_matrices(g.quats[row]), g.scales[row]
        M = T @ R * scales
        v_M = 2 * covariance_gradient(projection.cov2d[row], own, setting.eps2d, setting.antialiased) @ M
        v_t = point_gradient(projection.points[row], T, v_M * scales @ R.T, own, case)
        v_sh, v_mean = color_gradients(case, row, own.color)
        derived = {
            "means2d": own.mean2d,
            "means2d_abs": own.mean2d_abs,
            "logit_opacities": own.log_opacity * (1 - g.opacities[row]),
            "log_scales": (v_M * M).sum(0),
            "quats": quaternion_gradient(g.quats[row], T.T @ v_M * scales),
            "means": W.T @ v_t + v_mean,
            "sh0": v_sh[:1],
            "shN": torch.cat([v_sh[1:], v_sh.new_zeros(16 - len(v_sh), 3)]),
        }
        for name, value in derived.items():
            expected = getattr(truth, name)
            scale = float(expected.abs().max())
            torch.testing.assert_close(value, expected[row], atol=1e-10 * scale, rtol=1e-8, msg=f"{name}[{row}]")


def test_the_derived_ssim_gradient_is_that_of_autograd() -> None:
    rng = torch.Generator().manual_seed(0)
    x, y = (torch.rand(15, 13, 3, generator=rng, dtype=torch.float64) for _ in range(2))
    mu_x, mu_y = blur(x), blur(y)
    E = mu_x**2 + mu_y**2 + C1
    F = blur(x * x) - mu_x**2 + blur(y * y) - mu_y**2 + C2
    luminance, similarity = (2 * mu_x * mu_y + C1) / E, ssim_map(x, y)
    d_A, d_B = -similarity / F, 2 * luminance / F
    d_mu = 2 * (mu_y * similarity / luminance - mu_x * similarity) / E - 2 * mu_x * d_A - mu_y * d_B
    derived = 0.8 * (x - y).sign() / x.numel() - 0.2 / x.numel() * (blur(d_mu) + 2 * x * blur(d_A) + y * blur(d_B))
    torch.testing.assert_close(BACKEND.photometric(x, y, 0.2).v_colors, derived, atol=1e-12, rtol=1e-9)
