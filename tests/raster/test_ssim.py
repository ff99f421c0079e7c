"""The photometric loss: zero at the target, its closed form, and one home with the backend's."""

from __future__ import annotations

import pytest
import torch
from tolerances import LOSS, SSIM_GRADIENT
from torch import Tensor

from gsopt.raster.cpu_backend import CpuBackend
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


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize(
    ("height", "width", "boxes"),
    [
        (40, 50, [(10, 20, 12, 30)]),
        (64, 64, [(0, 1, 0, 1)]),
        (63, 65, [(62, 63, 64, 65)]),
        (61, 1700, [(10, 12, 3, 5), (50, 51, 1590, 1602)]),
        (37, 5, [(10, 11, 2, 3)]),
        (51, 333, [(20, 21, 0, 333)]),
    ],
)
def test_what_both_images_show_alike_adds_nothing(
    height: int, width: int, boxes: list[tuple[int, int, int, int]], *, textured: bool
) -> None:
    """Images that differ in boxes alone: the reference's numbers, and no gradient where no window reaches a box."""
    rng = torch.Generator().manual_seed(width)
    target = torch.rand(height, width, 3, generator=rng) if textured else torch.full((height, width, 3), 0.6)
    rendered, far = target.clone(), torch.ones(height, width, dtype=torch.bool)
    for y0, y1, x0, x1 in boxes:
        rendered[y0:y1, x0:x1] = torch.rand(y1 - y0, x1 - x0, 3, generator=rng)
        far[max(0, y0 - 12) : y1 + 12, max(0, x0 - 17) : x1 + 17] = False
    got = CpuBackend(2).photometric(rendered, target, 0.2)
    expected = ReferenceBackend().photometric(rendered.double(), target.double(), 0.2)
    assert got.loss == pytest.approx(expected.loss, abs=LOSS)
    error = torch.linalg.vector_norm(got.v_colors - expected.v_colors)
    assert float(error) <= SSIM_GRADIENT * float(torch.linalg.vector_norm(expected.v_colors))
    assert not bool(got.v_colors[far].any())


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_where_images_differ_is_the_same_for_any_number_of_threads(threads: int) -> None:
    rendered, target = (image.float() for image in images(61, 1650))
    rendered[:20], rendered[40:], rendered[20:40, 70:1630] = target[:20], target[40:], target[20:40, 70:1630]
    one, other = (CpuBackend(count).photometric(rendered, target, 0.2) for count in (1, threads))
    assert torch.equal(one.v_colors, other.v_colors)
    assert one.loss == other.loss
