"""Losses: zero at the target, their closed forms, and one home with the backend's photometric loss."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsopt import losses
from gsopt.raster.reference import ReferenceBackend


def images(height: int = 14, width: int = 12) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(0)
    return tuple(torch.rand(height, width, 3, generator=rng, dtype=torch.float64) for _ in range(2))  # type: ignore[return-value]


@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
def test_photometric_is_that_of_the_backend(lambda_dssim: float) -> None:
    rendered, target = images()
    rendered.requires_grad_()
    loss = losses.photometric(rendered, target, lambda_dssim)
    (gradient,) = torch.autograd.grad(loss, rendered)
    fused = ReferenceBackend().photometric(rendered, target, lambda_dssim)
    assert loss.item() == fused.loss
    assert torch.equal(gradient, fused.v_colors)
    expected = (1 - lambda_dssim) * losses.l1(rendered, target) + lambda_dssim * losses.dssim(rendered, target)
    assert loss.item() == pytest.approx(expected.item(), abs=1e-15)


def test_every_image_loss_is_zero_at_the_target_only() -> None:
    rendered, target = images()
    known = torch.ones_like(target[..., :1], dtype=torch.bool)
    for loss in (losses.l1, losses.dssim, losses.alpha_l1, lambda a, b: losses.depth_l1(a[..., :1], b[..., :1], known)):
        assert float(loss(target, target)) == pytest.approx(0, abs=1e-13)
        assert float(loss(rendered, target)) > 0.1


def test_l1_of_a_shift_is_the_shift() -> None:
    _, target = images()
    assert float(losses.l1(target + 0.25, target)) == pytest.approx(0.25)
    assert float(losses.alpha_l1(target[..., :1] - 0.125, target[..., :1])) == pytest.approx(0.125)


def test_unknown_depth_counts_for_nothing() -> None:
    depths = torch.tensor([[[1.0], [5.0]]]).requires_grad_()
    target = torch.tensor([[[3.0], [math.nan]]])
    known = torch.tensor([[[True], [False]]])
    loss = losses.depth_l1(depths, target, known)
    assert loss.item() == 2.0
    loss.backward()
    assert depths.grad is not None
    assert depths.grad.flatten().tolist() == [-1.0, 0.0]
    assert float(losses.depth_l1(depths, target, ~known & known)) == 0.0


def test_opacity_and_scale_are_means_of_the_activated_values() -> None:
    logits = torch.tensor([0.0, math.log(3.0)])
    assert float(losses.opacity(logits)) == pytest.approx((0.5 + 0.75) / 2)
    assert float(losses.scale(torch.tensor([[1.0, 2.0, 6.0]]).log())) == pytest.approx(3.0)
    assert float(losses.opacity(torch.zeros(0))) == 0.0
    assert float(losses.scale(torch.zeros(0, 3))) == 0.0
