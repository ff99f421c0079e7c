"""The photometric loss: zero at the target, its closed form, and one home with the backend's."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsopt.raster.reference import ReferenceBackend
from gsopt.raster.ssim import l1, photometric_terms, ssim


def images(height: int = 14, width: int = 12) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(0)
    return tuple(torch.rand(height, width, 3, generator=rng, dtype=torch.float64) for _ in range(2))  # type: ignore[return-value]


@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
def test_photometric_is_that_of_the_backend(lambda_dssim: float) -> None:
    rendered, target = images()
    rendered.requires_grad_()
    loss = photometric_terms(rendered, target, lambda_dssim)[2]
    (gradient,) = torch.autograd.grad(loss, rendered)
    fused = ReferenceBackend().photometric(rendered, target, lambda_dssim)
    assert loss.item() == fused.loss
    assert torch.equal(gradient, fused.v_colors)
    expected = (1 - lambda_dssim) * l1(rendered, target) + lambda_dssim * (1 - ssim(rendered, target))
    assert loss.item() == pytest.approx(expected.item(), abs=1e-15)


def test_every_image_loss_is_zero_at_the_target_only() -> None:
    rendered, target = images()
    for loss in (l1, lambda a, b: 1 - ssim(a, b)):
        assert float(loss(target, target)) == pytest.approx(0, abs=1e-13)
        assert float(loss(rendered, target)) > 0.1


def test_l1_of_a_shift_is_the_shift() -> None:
    _, target = images()
    assert float(l1(target + 0.25, target)) == pytest.approx(0.25)
