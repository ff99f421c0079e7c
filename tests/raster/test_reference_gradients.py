"""Every gradient of the reference equals a central difference, and the absolute one is the sum over single pixels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from raster_scenes import Case, make_case, weights_like, with_parameter
from tolerances import DIFFERENCE, DIFFERENCE_STEP, EXACT
from torch import Tensor

from gsopt.gaussians import PARAMETERS
from gsopt.raster.backend import TRANSMITTANCE_MIN, AdamStep, RasterSettings, RenderedFrame
from gsopt.raster.reference import ReferenceBackend, project
from gsopt.raster.ssim import WINDOW, ssim, ssim_map, window

SMOOTH = ReferenceBackend(smooth_cutoff=True)


def dense() -> Case:
    """Big opaque layers, some far off the axis: clamps at 0.99, early stops and clamped Jacobians."""
    case = make_case(206, count=16, width=6, height=6, settings=RasterSettings(sh_degree=1), sh_degree=1)
    g = case.gaussians
    return replace(case, gaussians=replace(g, logit_opacities=g.logit_opacities + 3, log_scales=g.log_scales + 1))


CASES = {
    "plain": make_case(15, count=5, width=9, height=8),
    "antialiased": make_case(14, count=5, width=8, height=9, settings=RasterSettings(antialiased=True)),
    "dense": dense(),
}


def draw(case: Case) -> RenderedFrame:
    return SMOOTH.forward(case.gaussians, case.camera, case.settings, case.background, depth=True)


def weighted_sum(case: Case) -> float:
    frame = draw(case)
    assert frame.depths is not None
    v_colors, v_alphas, v_depths = weights_like(case)
    return float((frame.colors * v_colors).sum() + (frame.alphas * v_alphas).sum() + (frame.depths * v_depths).sum())


def central_differences(case: Case, name: str, indices: range) -> Tensor:
    value: Tensor = getattr(case.gaussians, name)
    out = torch.zeros(len(indices), dtype=torch.float64)
    for slot, index in enumerate(indices):
        sums = []
        for sign in (1, -1):
            moved = value.clone()
            moved.view(-1)[index] += sign * DIFFERENCE_STEP
            sums.append(weighted_sum(with_parameter(case, name, moved)))
        out[slot] = (sums[0] - sums[1]) / (2 * DIFFERENCE_STEP)
    return out


def test_the_dense_case_reaches_the_clamp_the_stop_and_the_rim() -> None:
    case = CASES["dense"]
    frame = draw(case)
    projection = project(case.gaussians, case.camera, case.settings)
    focal = case.camera.Ks[0].diagonal()[:2]
    slopes = (projection.points[:, :2] / projection.points[:, 2:]).abs()
    off_axis = (slopes > 1.3 * 3 / focal + 3 / focal).any(dim=1) & (projection.points[:, 2] > 0)
    assert bool((off_axis & (frame.radii > 0).all(dim=1)).any())
    assert float(projection.opacities.max()) > 0.99
    assert float(frame.alphas.max()) > 1 - TRANSMITTANCE_MIN


@pytest.mark.parametrize("which", CASES)
def test_no_case_has_two_gaussians_that_a_step_could_swap(which: str) -> None:
    case = CASES[which]
    depths = project(case.gaussians, case.camera, case.settings).points[:, 2]
    assert float(depths.sort().values.diff().min()) > 10 * DIFFERENCE_STEP


@pytest.mark.parametrize("name", PARAMETERS)
@pytest.mark.parametrize("which", CASES)
def test_a_gradient_is_the_central_difference(which: str, name: str) -> None:
    case = CASES[which]
    gradient = getattr(SMOOTH.backward(draw(case), *weights_like(case)), name)
    # All entries of the small parameters; of the large ones about forty, with a stride that meets every band and axis.
    indices = range(0, gradient.numel(), max(1, gradient.numel() // 40) | 1)
    difference = central_differences(case, name, indices)
    scale = float(gradient.abs().max())
    assert scale > 1e-3
    torch.testing.assert_close(gradient.flatten()[list(indices)], difference, rtol=0, atol=DIFFERENCE * scale)


def test_bands_above_the_rendered_degree_have_no_gradient() -> None:
    case = make_case(11, settings=RasterSettings(sh_degree=1))
    shN = SMOOTH.backward(draw(case), *weights_like(case)).shN
    assert shN.shape[1] == 15
    assert float(shN[:, 3:].abs().max()) == 0
    assert float(shN[:, :3].abs().max()) > 0


def test_the_gradient_of_the_projected_mean_predicts_a_shift_of_the_principal_point() -> None:
    case = CASES["plain"]
    gradients = SMOOTH.backward(draw(case), *weights_like(case))
    # Jacobian and clamp bounds are evaluated with the old principal point: none of these rows is near the rim.
    sums = []
    for sign in (1, -1):
        Ks = case.camera.Ks.clone()
        Ks[0, 0, 2] += sign * DIFFERENCE_STEP
        camera = type(case.camera)(case.camera.viewmats, Ks, case.camera.width, case.camera.height)
        sums.append(weighted_sum(Case(case.gaussians, camera, case.settings, case.background, case.seed)))
    difference = (sums[0] - sums[1]) / (2 * DIFFERENCE_STEP)
    assert float(gradients.means2d[:, 0].sum()) == pytest.approx(difference, rel=1e-6)


def test_the_absolute_gradient_sums_the_magnitudes_of_single_pixels() -> None:
    case = make_case(11, count=6, width=7, height=6)
    v = weights_like(case)
    got = SMOOTH.backward(draw(case), *v, absgrad=True)
    expected = torch.zeros_like(got.means2d)
    signed = torch.zeros_like(got.means2d)
    for row in range(6):
        for column in range(7):
            only = torch.zeros(6, 7, dtype=torch.float64)
            only[row, column] = 1
            pixel = SMOOTH.backward(draw(case), v[0] * only[..., None], v[1] * only, v[2] * only).means2d
            expected += pixel.abs()
            signed += pixel
    torch.testing.assert_close(got.means2d_abs, expected, atol=1e-10, rtol=1e-10)
    torch.testing.assert_close(got.means2d, signed, atol=1e-10, rtol=1e-10)
    assert bool((expected > signed.abs() + 1e-6).any())


def images(seed: int, height: int = 13, width: int = 9) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=rng, dtype=torch.float64)
    return (target + 0.2 * torch.randn(height, width, 3, generator=rng, dtype=torch.float64)), target


def test_ssim_equals_its_definition_pixel_by_pixel() -> None:
    rendered, target = images(0)
    weights = torch.outer(window(rendered), window(rendered))[..., None]
    reach = WINDOW // 2
    padded = [torch.nn.functional.pad(image, (0, 0, reach, reach, reach, reach)) for image in images(0)]
    got = ssim_map(rendered, target)
    for row, column in ((0, 0), (6, 4), (12, 3), (5, 8)):
        x, y = (image[row : row + WINDOW, column : column + WINDOW] for image in padded)
        mx, my = (weights * x).sum((0, 1)), (weights * y).sum((0, 1))
        vx, vy = (weights * (x - mx) ** 2).sum((0, 1)), (weights * (y - my) ** 2).sum((0, 1))
        cov = (weights * (x - mx) * (y - my)).sum((0, 1))
        expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
        torch.testing.assert_close(got[row, column], expected, atol=EXACT, rtol=0)


def test_ssim_is_symmetric_bounded_and_one_for_equal_images() -> None:
    rendered, target = images(1)
    assert float(ssim(rendered, rendered)) == pytest.approx(1, abs=EXACT)
    assert float(ssim(rendered, target)) == pytest.approx(float(ssim(target, rendered)), abs=EXACT)
    assert float(ssim(rendered, target)) < 1
    assert float(window(rendered).sum()) == pytest.approx(1, abs=EXACT)
    batch = ssim_map(torch.stack([rendered, target]), torch.stack([target, target]))
    torch.testing.assert_close(batch[0], ssim_map(rendered, target))


def test_the_photometric_gradient_is_the_central_difference() -> None:
    rendered, target = images(2, height=6, width=5)
    result = SMOOTH.photometric(rendered, target, 0.2)
    assert result.loss == pytest.approx(0.8 * result.l1 + 0.2 * (1 - result.ssim), abs=EXACT)
    for index in range(0, rendered.numel(), 7):
        losses = []
        for sign in (1, -1):
            moved = rendered.clone()
            moved.view(-1)[index] += sign * DIFFERENCE_STEP
            losses.append(SMOOTH.photometric(moved, target, 0.2).loss)
        difference = (losses[0] - losses[1]) / (2 * DIFFERENCE_STEP)
        assert float(result.v_colors.view(-1)[index]) == pytest.approx(difference, abs=1e-9)


def test_adam_takes_the_steps_of_torch() -> None:
    case, rng = make_case(15, count=5), torch.Generator().manual_seed(0)
    means = torch.randn(5, 3, generator=rng, dtype=torch.float64)
    twin = means.clone().requires_grad_()
    optimizer = torch.optim.Adam([twin], lr=1e-2, betas=(0.8, 0.99), eps=1e-15)
    gaussians = replace(case.gaussians, means=means)
    m, v = (replace(case.gaussians, means=torch.zeros_like(means)) for _ in range(2))
    gradients = SMOOTH.backward(draw(case), *weights_like(case))
    for number in range(1, 6):
        grad = torch.randn(5, 3, generator=rng, dtype=torch.float64)
        twin.grad = grad.clone()
        optimizer.step()
        step = AdamStep({"means": 1e-2}, {"means": number}, 0.8, 0.99, 1e-15)
        SMOOTH.adam(gaussians, replace(gradients, means=grad), m, v, step, case.camera, case.settings)
    torch.testing.assert_close(means, twin.detach(), atol=EXACT, rtol=0)
