"""Every closed form is the derivative of the term it belongs to."""

from __future__ import annotations

import math

import pytest
import torch
from tiny_scenes import cloud
from torch import Tensor

from gsopt.training.regularizers import (
    ABSENT,
    Dropout,
    add_area_gradient,
    add_opacity_gradient,
    add_scale_gradient,
    alpha_gradient,
)

COUNT = 50


def opacity_loss(logit_opacities: Tensor) -> Tensor:
    """Mean opacity (Kheradmand et al. 2024, eq. 8); 0 for no Gaussians."""
    return torch.sigmoid(logit_opacities).sum() / max(1, logit_opacities.numel())


def scale_loss(log_scales: Tensor) -> Tensor:
    """Mean standard deviation over Gaussians and axes (Kheradmand et al. 2024, eq. 8); 0 for none."""
    return log_scales.exp().sum() / max(1, log_scales.numel())


def area_loss(log_scales: Tensor) -> Tensor:
    """Mean variance over Gaussians and axes; 0 for none."""
    return (2 * log_scales).exp().sum() / max(1, log_scales.numel())


def alpha_loss(alphas: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference between the rendered alpha and the image's alpha or mask."""
    return (alphas - target).abs().mean()


def autograd(function, at: Tensor) -> Tensor:
    leaf = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf), leaf)
    return gradient


@pytest.fixture
def gaussians():
    return cloud(COUNT, seed=3).to(torch.float64)


def test_the_terms_are_means_of_the_activated_values() -> None:
    logits = torch.tensor([0.0, math.log(3.0)])
    assert float(opacity_loss(logits)) == pytest.approx((0.5 + 0.75) / 2)
    assert float(scale_loss(torch.tensor([[1.0, 2.0, 6.0]]).log())) == pytest.approx(3.0)
    assert float(area_loss(torch.tensor([[1.0, 2.0, 5.0]]).log())) == pytest.approx(10.0)
    target = torch.rand(5, 7, generator=torch.Generator().manual_seed(2))
    assert float(alpha_loss(target, target)) == 0
    assert float(alpha_loss(target - 0.125, target)) == pytest.approx(0.125)


def test_opacity_term(gaussians) -> None:
    gradient = torch.ones(COUNT, dtype=torch.float64)
    add_opacity_gradient(gradient, gaussians.logit_opacities, 0.3)
    expected = 1 + 0.3 * autograd(opacity_loss, gaussians.logit_opacities)
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=0)


def test_scale_term(gaussians) -> None:
    gradient = torch.ones(COUNT, 3, dtype=torch.float64)
    add_scale_gradient(gradient, gaussians.log_scales, 0.3)
    torch.testing.assert_close(gradient, 1 + 0.3 * autograd(scale_loss, gaussians.log_scales), rtol=1e-12, atol=0)


def test_area_term(gaussians) -> None:
    gradient = torch.ones(COUNT, 3, dtype=torch.float64)
    add_area_gradient(gradient, gaussians.log_scales, 0.3)
    torch.testing.assert_close(gradient, 1 + 0.3 * autograd(area_loss, gaussians.log_scales), rtol=1e-12, atol=0)


def test_alpha_term() -> None:
    generator = torch.Generator().manual_seed(1)
    alphas, target = torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    expected = 0.3 * autograd(lambda a: alpha_loss(a[..., None], target[..., None]), alphas)
    torch.testing.assert_close(alpha_gradient(alphas, target, 0.3), expected, rtol=1e-12, atol=0)


def test_terms_of_a_single_gaussian() -> None:
    opacity, scale = torch.zeros(1), torch.zeros(1, 3)
    add_opacity_gradient(opacity, torch.zeros(1), 1.0)
    add_scale_gradient(scale, torch.zeros(1, 3), 1.0)
    assert (opacity.tolist(), scale.tolist()) == ([0.25], [[pytest.approx(1 / 3)] * 3])
    add_area_gradient(scale, torch.zeros(1, 3), 1.0)
    assert scale.tolist() == [[pytest.approx(1 / 3 + 2 / 3)] * 3]


def test_terms_of_an_empty_scene_are_empty() -> None:
    opacities, scales = torch.empty(0), torch.empty(0, 3)
    add_opacity_gradient(opacities, torch.empty(0), 1.0)
    add_scale_gradient(scales, torch.empty(0, 3), 1.0)
    add_area_gradient(scales, torch.empty(0, 3), 1.0)
    assert (opacities.shape, scales.shape) == ((0,), (0, 3))
    assert float(opacity_loss(opacities)) == 0 == float(scale_loss(scales)) == float(area_loss(scales))


def test_dropout_keeps_the_mean_opacity_and_the_rest_of_the_record(gaussians) -> None:
    gaussians = cloud(20_000, seed=5).to(torch.float64)
    dropout = Dropout.of(gaussians, 0.25, torch.Generator().manual_seed(0))
    drawn = dropout.drawn.opacities
    left_out = dropout.drawn.logit_opacities == ABSENT
    assert float(left_out.double().mean()) == pytest.approx(0.25, abs=0.01)
    kept = ~left_out
    expected = (gaussians.opacities / 0.75).clamp_max(0.999)
    torch.testing.assert_close(drawn[kept], expected[kept], rtol=1e-9, atol=0)
    assert float(drawn[left_out].max()) < 1e-40
    assert dropout.drawn.means is gaussians.means


def test_dropout_slope_is_the_central_difference_of_the_drawn_logit(gaussians) -> None:
    def drawn_logits(shift: float) -> Dropout:
        moved = gaussians.logit_opacities + shift
        record = type(gaussians)(**{**dict(gaussians.items()), "logit_opacities": moved})
        return Dropout.of(record, 0.2, torch.Generator().manual_seed(9))

    h = 1e-5
    difference = (drawn_logits(h).drawn.logit_opacities - drawn_logits(-h).drawn.logit_opacities) / (2 * h)
    slope = drawn_logits(0.0).slope
    assert 0 < int((slope == 0).sum()) < COUNT  # some left out, some drawn
    torch.testing.assert_close(slope, difference, rtol=1e-5, atol=1e-8)


def test_dropout_passes_nothing_where_the_opacity_is_clamped(gaussians) -> None:
    opaque = type(gaussians)(**{**dict(gaussians.items()), "logit_opacities": torch.full((COUNT,), 9.0).double()})
    dropout = Dropout.of(opaque, 0.2, torch.Generator().manual_seed(9))
    assert not dropout.slope.any()
    assert float(dropout.drawn.opacities.max()) == pytest.approx(0.999)
