"""A frame's loss puts its terms together: which of them count, by how much, and through what."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud, ring
from torch import Tensor

from gsopt.raster.backend import RasterSettings, RenderedFrame
from gsopt.raster.reference import ReferenceBackend
from gsopt.training.frame_loss import depth_gradients, frame_loss
from gsopt.training.plan import LossWeights
from gsopt.training.regularizers import alpha_gradient
from gsopt.training.targets import Target

BACKEND = ReferenceBackend()
GRAY = torch.tensor([0.3, 0.5, 0.7])
WEIGHTS = LossWeights(dssim=0.2, alpha=0.0, opacity=0.0, scale=0.0, area=0.0, depth=0.1, agreed=0.0, unseen=0.0)


@dataclass
class Brighter:
    """An exposure of twice the colors, that says what it was asked for."""

    asked: list[Any] = field(default_factory=list)

    def exposed(self, row: int, frame: RenderedFrame, background: Tensor | None) -> Tensor:
        self.asked.append((row, background))
        return 2 * frame.colors

    def backward(
        self, row: int, step: int, frame: RenderedFrame, background: Tensor | None, v_exposed: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        self.asked.append((row, step, background))
        return 2 * v_exposed, None if background is None else torch.full_like(frame.alphas, 0.125)


def drawn(*, depth: bool = False) -> RenderedFrame:
    return BACKEND.forward(cloud(60, seed=3), ring(3, 1.0)[0], RasterSettings(sh_degree=1), GRAY, depth=depth)


def wanted(*, alpha: bool = True, depth: bool = False, color: float = 1.0, rows: int = 24) -> Target:
    random = torch.Generator().manual_seed(5)
    colors, alphas, depths = (torch.rand(*shape, generator=random) for shape in ((24, 24, 3), (24, 24), (24, 24)))
    alphas = (alphas > 0.2).float() if alpha else None  # type: ignore[assignment]
    size = (24 * 24 // rows, 24)
    return Target(ring(1, 1.0)[0], colors, alphas, size, color, depths if depth else None)


def of(frame: RenderedFrame, target: Target, weights: LossWeights = WEIGHTS, **photo: Any) -> Any:
    exposure, row = photo.get("exposure"), photo.get("row")
    return frame_loss(BACKEND, frame, target, weights, GRAY, exposure, row, step=7)


def test_colors_count_by_the_weight_of_the_view_and_the_share_of_the_window() -> None:
    frame, whole = drawn(), of(drawn(), wanted())
    plain = BACKEND.photometric(frame.colors, wanted().colors, 0.2)
    torch.testing.assert_close(whole.v_colors, plain.v_colors)
    assert whole.photometric == pytest.approx(plain.loss)
    faint = of(frame, wanted(color=0.25, rows=12))  # a window of half the whole image
    torch.testing.assert_close(faint.v_colors, plain.v_colors / 8)
    assert faint.photometric == pytest.approx(plain.loss / 8)
    assert whole.v_alphas is whole.v_depths is None


@pytest.mark.parametrize(("alpha", "weight", "counts"), [(True, 0.25, True), (True, 0.0, False), (False, 0.25, False)])
def test_alphas_count_where_they_have_a_weight_and_the_photo_has_some(alpha: bool, weight: float, counts: bool) -> None:
    frame, target = drawn(), wanted(alpha=alpha, color=0.5, rows=12)
    found = of(frame, target, replace(WEIGHTS, alpha=weight)).v_alphas
    if counts:
        torch.testing.assert_close(found, alpha_gradient(frame.alphas, target.alphas, weight / 2))
    else:
        assert found is None


def test_depths_count_where_the_photo_has_a_map_and_the_frame_has_depths() -> None:
    frame, target = drawn(depth=True), wanted(depth=True, rows=12)
    found = of(frame, target)
    through = depth_gradients(frame.depths, frame.alphas, target, 0.05)  # type: ignore[arg-type]
    assert through[0].any()
    torch.testing.assert_close(found.v_depths, through[0])
    torch.testing.assert_close(found.v_alphas, through[1])
    with_alphas = of(frame, target, replace(WEIGHTS, alpha=0.25))
    torch.testing.assert_close(with_alphas.v_alphas, through[1] + alpha_gradient(frame.alphas, target.alphas, 0.125))
    assert of(drawn(), target).v_depths is None
    assert of(frame, wanted()).v_depths is None


@pytest.mark.parametrize("alpha", [True, False])
def test_a_photo_with_an_exposure_is_compared_as_it_was_exposed(alpha: bool) -> None:
    frame, target, exposure = drawn(), wanted(alpha=alpha), Brighter()
    found = of(frame, target, exposure=exposure, row=2)
    bright = BACKEND.photometric(2 * frame.colors, target.colors, 0.2)
    torch.testing.assert_close(found.v_colors, 2 * bright.v_colors)
    assert found.photometric == pytest.approx(bright.loss)
    behind = GRAY if alpha else None  # what shows through a photo without alpha is its own
    assert exposure.asked == [(2, behind), (2, 7, behind)]
    assert (found.v_alphas is None) == (not alpha)
    guessed = Brighter()
    torch.testing.assert_close(of(frame, target, exposure=guessed).v_colors, of(frame, target).v_colors)
    assert guessed.asked == []
