"""The window of a masked image at its limits, and what a target is by default."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_skipping import big_ring
from test_targets import WHITE, pictures

from gsopt.training.content_window import Window, content_window, draws_whole
from gsopt.training.targets import Target, Targets, cropped


def test_the_camera_of_a_window_has_the_lens_of_the_whole_and_another_principal_point() -> None:
    whole = big_ring().camera
    part = Window(16, 74, 32, 76).camera(whole)
    expected = whole.Ks.clone()
    expected[0, 0, 2] -= 32
    expected[0, 1, 2] -= 16
    assert torch.equal(part.Ks, expected)
    assert (part.width, part.height) == (44, 58)
    assert torch.equal(part.viewmats, whole.viewmats)


@pytest.mark.parametrize(("last", "window"), [(73, None), (72, Window(0, 100, 0, 89))])
def test_nine_tenths_of_an_image_are_not_worth_a_copy(last: int, window: Window | None) -> None:
    """With the margin of 16 px columns 0 to 90 of 100, or to 89."""
    alphas = torch.zeros(100, 100)
    alphas[:, : last + 1] = 0.01
    assert content_window(alphas) == window


def test_one_step_in_eight_draws_the_whole() -> None:
    assert [step for step in range(1, 25) if draws_whole(step)] == [8, 16, 24]


def test_a_target_without_alpha_is_not_cropped() -> None:
    whole = replace(big_ring(), alphas=None)
    assert cropped(whole) is whole
    assert whole.color == 1.0
    assert whole.share == 1.0


def test_a_target_is_the_whole_image_unless_its_window_is_asked_for() -> None:
    views = pictures(4, height=96, width=96)
    for view in views:
        view.values[..., 3] = 0
        view.values[40:44, 40:44, 3] = 255
    targets = Targets(views, WHITE, budget=10**9)  # type: ignore[arg-type]
    assert targets.get(0, 1, WHITE).colors.shape == (96, 96, 3)
    window: Target = targets.get(0, 1, WHITE, whole=False)
    assert window.colors.shape == (44, 44, 3)
    assert window.size == (96, 96)
    assert targets.get(0, 1, WHITE) is targets.get(0, 1, WHITE)
    assert targets.get(0, 1, WHITE, whole=False) is window
