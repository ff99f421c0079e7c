"""Laws of the image: closed forms, invariances, the stop, the clamp, the order and what is culled."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from raster_scenes import Case, cases, make_case, with_parameter
from tolerances import EXACT
from torch import Tensor

from gsopt.errors import UsageError
from gsopt.gaussians import Gaussians
from gsopt.geometry import quats, sh
from gsopt.geometry.cameras import Cameras, intrinsics
from gsopt.raster import reference
from gsopt.raster.backend import ALPHA_MIN, RasterSettings, RenderedFrame

BACKEND = reference.ReferenceBackend()
drawn = settings(max_examples=25, deadline=None, derandomize=True)


def draw(case: Case, background: bool = True) -> RenderedFrame:
    return BACKEND.forward(
        case.gaussians, case.camera, case.settings, case.background if background else None, depth=True
    )


def on_axis(depths: list[float], logits: list[float], scale: float = 0.2, eps2d: float = 0.3) -> Case:
    """Isotropic Gaussians on the optical axis of a 9x9 camera whose middle pixel's center is the principal point."""
    n = len(depths)
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, z] for z in depths], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(scale), dtype=torch.float64),
        logit_opacities=torch.tensor(logits, dtype=torch.float64),
        sh0=torch.linspace(-1, 1, 3 * n, dtype=torch.float64).view(n, 1, 3),
        shN=torch.zeros(n, 0, 3, dtype=torch.float64),
    )
    camera = Cameras(torch.eye(4, dtype=torch.float64)[None], intrinsics(1.0, 9, 9)[None], 9, 9)
    return Case(gaussians, camera, RasterSettings(eps2d=eps2d), torch.zeros(3, dtype=torch.float64), seed=0)


def radius_squared() -> Tensor:
    offsets = torch.arange(9, dtype=torch.float64) - 4
    return offsets[:, None] ** 2 + offsets[None, :] ** 2


@pytest.mark.parametrize("antialiased", [False, True])
def test_an_isotropic_gaussian_matches_its_closed_form(antialiased: bool) -> None:
    case = on_axis([3.0], [0.4])
    case = replace(case, settings=replace(case.settings, antialiased=antialiased))
    focal = float(case.camera.Ks[0, 0, 0])
    own = (focal * 0.2 / 3.0) ** 2
    variance = own + 0.3
    opacity = 1 / (1 + math.exp(-0.4)) * (own / variance if antialiased else 1)
    alpha = opacity * torch.exp(-0.5 * radius_squared() / variance)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    color = 0.5 + sh.C0 * case.gaussians.sh0[0, 0]
    frame = draw(case)
    assert (alpha == 0).any()
    assert (alpha > 0).any()
    torch.testing.assert_close(frame.alphas, alpha, atol=EXACT, rtol=0)
    torch.testing.assert_close(frame.colors, alpha[..., None] * color, atol=EXACT, rtol=0)
    torch.testing.assert_close(frame.depths, alpha * 3.0, atol=EXACT, rtol=0)
    radius = math.ceil(math.sqrt(2 * math.log(255 * opacity) * variance))
    assert frame.radii.tolist() == [[radius, radius]]
    assert frame.radii.dtype == torch.int32


@drawn
@given(case=cases())
def test_the_covariance_is_propagated_through_the_derivative_of_the_pinhole(case: Case) -> None:
    camera = case.camera
    projection = reference.project(case.gaussians, camera, case.settings)
    R, K = camera.viewmats[0, :3, :3], camera.Ks[0]

    def pixel(point: Tensor) -> Tensor:
        homogeneous = K @ point
        return homogeneous[:2] / homogeneous[2]

    spread = reference.covariances(case.gaussians.quats, case.gaussians.log_scales)
    widened = 0.15 * torch.tensor([camera.width, camera.height])
    for point, mean2d, cov2d, cov in zip(projection.points, projection.means2d, projection.cov2d, spread, strict=True):
        inside = (mean2d > -widened).all() and (mean2d < K.new_tensor([camera.width, camera.height]) + widened).all()
        if point[2] < 0.01 or not inside:
            continue
        torch.testing.assert_close(pixel(point), mean2d, atol=EXACT, rtol=EXACT)
        J = torch.autograd.functional.jacobian(pixel, point) @ R
        expected = J @ cov @ J.T + case.settings.eps2d * torch.eye(2, dtype=torch.float64)
        torch.testing.assert_close(cov2d, expected, atol=EXACT, rtol=1e-9)


def test_the_jacobian_stays_at_the_rim_of_the_widened_view() -> None:
    K = intrinsics(1.0, 20, 10)
    K[0, 2] = 7.0
    tan_x = 0.5 * 20 / K[0, 0]
    left, right = -(7.0 / K[0, 0] + 0.3 * tan_x), (20 - 7.0) / K[0, 0] + 0.3 * tan_x
    rim = torch.stack([torch.tensor([slope, 0.0, 1.0], dtype=torch.float64) for slope in (left, right)])
    beyond = rim * torch.tensor([2.0, 1.0, 1.0])
    torch.testing.assert_close(reference.jacobians(beyond, K, 20, 10), reference.jacobians(rim, K, 20, 10))
    inside = rim * torch.tensor([0.9, 1.0, 1.0])
    assert not torch.allclose(reference.jacobians(inside, K, 20, 10), reference.jacobians(rim, K, 20, 10))


def rotate_sh(coefficients: Tensor, R: Tensor) -> Tensor:
    """Coefficients of the rotated function: solved from its values in many directions (shapes [N,16,3])."""
    directions = torch.nn.functional.normalize(torch.randn(64, 3, dtype=torch.float64), dim=-1)
    values = torch.einsum("dk,nkc->dnc", sh.basis(directions, 3), coefficients)
    Y = sh.basis(directions @ R.T, 3)
    return (torch.linalg.pinv(Y) @ values.flatten(1)).view(16, -1, 3).transpose(0, 1)


def orthonormal(camera: Cameras) -> Cameras:
    """The same camera with a rotation that is one to float64, not only to float32."""
    viewmats = camera.viewmats.clone()
    U, _, Vh = torch.linalg.svd(viewmats[:, :3, :3])
    viewmats[:, :3, :3] = U @ Vh
    return replace(camera, viewmats=viewmats)


@drawn
@given(case=cases())
def test_moving_the_world_and_the_camera_together_changes_nothing(case: Case) -> None:
    torch.manual_seed(case.seed)
    g = case.gaussians.with_sh_degree(3)
    case = replace(case, gaussians=g, camera=orthonormal(case.camera))
    turn = torch.randn(4, dtype=torch.float64)
    R, shift = quats.rotation_matrices(turn), torch.randn(3, dtype=torch.float64)
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3], world[:3, 3] = R, shift
    rotated = rotate_sh(torch.cat([g.sh0, g.shN], dim=1), R)
    moved = replace(
        case,
        gaussians=replace(
            g,
            means=g.means @ R.T + shift,
            quats=quats.multiply(turn.expand_as(g.quats), g.quats),
            sh0=rotated[:, :1],
            shN=rotated[:, 1:],
        ),
        camera=replace(case.camera, viewmats=case.camera.viewmats @ torch.linalg.inv(world)),
    )
    before, after = draw(case), draw(moved)
    torch.testing.assert_close(before.colors, after.colors, atol=1e-10, rtol=0)
    torch.testing.assert_close(before.depths, after.depths, atol=1e-10, rtol=0)
    assert torch.equal(before.radii, after.radii)


@drawn
@given(case=cases())
def test_the_order_of_storage_does_not_matter(case: Case) -> None:
    torch.manual_seed(case.seed)
    # No two at the same depth, for which the order of storage is the order of drawing.
    means = case.gaussians.means + 1e-3 * torch.randn(len(case.gaussians), 3, dtype=torch.float64)
    case = with_parameter(case, "means", means)
    order = torch.randperm(len(means))
    shuffled = replace(case, gaussians=case.gaussians.select(order))
    before, after = draw(case), draw(shuffled)
    torch.testing.assert_close(before.colors, after.colors, atol=EXACT, rtol=0)
    assert torch.equal(before.radii[order], after.radii)


@drawn
@given(case=cases())
def test_alpha_is_a_fraction_and_the_background_shows_through_the_rest(case: Case) -> None:
    bare, on_background = draw(case, background=False), draw(case)
    assert float(bare.alphas.min()) >= 0
    assert float(bare.alphas.max()) <= 1
    assert torch.equal(bare.alphas, on_background.alphas)
    expected = bare.colors + (1 - bare.alphas[..., None]) * case.background
    torch.testing.assert_close(on_background.colors, expected, atol=EXACT, rtol=0)


@drawn
@given(case=cases())
def test_a_radius_bounds_the_splat_and_zero_means_not_drawn(case: Case) -> None:
    full = draw(case)
    seen = (full.radii > 0).all(dim=1)
    without = draw(replace(case, gaussians=case.gaussians.select(seen)))
    assert torch.equal(full.colors, without.colors)
    means2d = reference.project(case.gaussians, case.camera, case.settings).means2d
    for row in torch.nonzero(seen)[:, 0].tolist():
        alone = draw(replace(case, gaussians=case.gaussians.select(torch.tensor([row])))).alphas
        y, x = torch.nonzero(alone > 0, as_tuple=True)
        offsets = (torch.stack([x, y], dim=-1) + 0.5 - means2d[row]).abs()
        assert (offsets <= full.radii[row]).all()


def test_a_pixel_stops_once_its_transmittance_is_used_up() -> None:
    # Opacity 0.95 in the middle: T is 5e-2, 2.5e-3, 1.25e-4 (goes on), 6e-6 (stops).
    logit = math.log(0.95 / 0.05)
    case = on_axis([3.0, 4.0, 5.0, 6.0, 7.0], [logit] * 5)
    colors = [draw(replace(case, gaussians=case.gaussians.select(torch.arange(n)))).colors[4, 4] for n in (3, 4, 5)]
    assert torch.equal(colors[1], colors[2])
    assert not torch.equal(colors[0], colors[1])
    frame = draw(case)
    assert float(frame.alphas[4, 4]) == pytest.approx(1 - 0.05**4, abs=EXACT)
    v = torch.zeros_like(frame.colors)
    v[4, 4] = 1
    touched = BACKEND.backward(frame, v).sh0.abs().sum(dim=(1, 2)) > 0
    assert touched.tolist() == [True, True, True, True, False]


def test_alpha_is_clamped_and_its_derivative_there_is_zero() -> None:
    frame = draw(on_axis([3.0], [9.0]))
    assert float(frame.alphas[4, 4]) == pytest.approx(0.99, abs=EXACT)
    v = torch.zeros_like(frame.colors)
    v[4, 4] = 1
    gradients = BACKEND.backward(frame, v)
    assert float(gradients.logit_opacities.abs().max()) == 0
    assert float(gradients.log_scales.abs().max()) == 0
    assert float(gradients.sh0.abs().max()) > 0


def test_equal_depths_are_drawn_in_the_order_of_storage() -> None:
    case = on_axis([3.0, 3.0], [2.0, 2.0])
    front = 0.5 + sh.C0 * case.gaussians.sh0[:, 0]
    alpha = float(case.gaussians.opacities[0])
    expected = alpha * front[0] + (1 - alpha) * alpha * front[1]
    torch.testing.assert_close(draw(case).colors[4, 4], expected, atol=EXACT, rtol=0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", [0.0, 0.0, 0.5]),
        ("means", [0.0, 0.0, -3.0]),
        ("means", [0.0, 0.0, 30.0]),
        ("means", [30.0, 0.0, 3.0]),
        ("logit_opacities", -5.55),
        ("log_scales", [800.0, 0.0, 0.0]),
    ],
)
def test_what_cannot_be_seen_is_culled_and_has_no_gradient(name: str, value: float | list[float]) -> None:
    case = on_axis([3.0, 4.0], [0.0, 0.0])
    case = replace(case, settings=replace(case.settings, near_plane=0.5, far_plane=30.0))
    changed = getattr(case.gaussians, name).clone()
    changed[0] = torch.tensor(value)
    frame = draw(with_parameter(case, name, changed))
    alone = draw(replace(case, gaussians=case.gaussians.select(torch.tensor([1]))))
    assert frame.radii[0].tolist() == [0, 0]
    assert torch.equal(frame.colors, alone.colors)
    gradients = BACKEND.backward(frame, torch.ones_like(frame.colors))
    for parameter in ("means", "quats", "log_scales", "logit_opacities", "sh0"):
        gradient = getattr(gradients, parameter)
        assert bool(torch.isfinite(gradient).all())
        assert float(gradient[0].abs().max()) == 0


def test_an_empty_scene_is_the_background() -> None:
    case = make_case(0, count=3)
    case = replace(case, gaussians=case.gaussians.select(torch.arange(0)))
    frame = draw(case)
    assert torch.equal(frame.colors, case.background.expand_as(frame.colors))
    assert float(frame.alphas.abs().max()) == 0
    gradients = BACKEND.backward(frame, torch.ones_like(frame.colors), absgrad=True)
    assert gradients.means.shape == (0, 3)
    assert gradients.means2d_abs is not None
    assert gradients.means2d_abs.shape == (0, 2)


def test_the_image_does_not_depend_on_the_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    case = make_case(3)
    whole = draw(case)
    expected = BACKEND.backward(whole, torch.ones_like(whole.colors), absgrad=True)
    monkeypatch.setattr(reference, "PAIRS_PER_CHUNK", 50)
    pieces = draw(case)
    torch.testing.assert_close(pieces.colors, whole.colors, atol=EXACT, rtol=0)
    got = BACKEND.backward(pieces, torch.ones_like(whole.colors), absgrad=True)
    torch.testing.assert_close(got.means, expected.means, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(got.means2d_abs, expected.means2d_abs, atol=1e-9, rtol=1e-9)


def test_it_draws_in_the_dtype_of_the_gaussians() -> None:
    case = make_case(1)
    single = draw(replace(case, gaussians=case.gaussians.to(torch.float32)))
    assert single.colors.dtype == torch.float32
    gradients = BACKEND.backward(single, torch.ones_like(single.colors))
    assert gradients.means.dtype == torch.float32
    assert draw(case).colors.dtype == torch.float64


def test_a_frame_is_used_once_and_one_camera_is_drawn() -> None:
    case = make_case(1)
    frame = draw(case)
    BACKEND.backward(frame, torch.ones_like(frame.colors))
    with pytest.raises(UsageError, match="already ran"):
        BACKEND.backward(frame, torch.ones_like(frame.colors))
    with pytest.raises(UsageError, match="one camera at a time, got 2"):
        BACKEND.forward(case.gaussians, Cameras.cat([case.camera, case.camera]), case.settings)
