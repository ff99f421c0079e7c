"""The targets of a step: the picture on its background, whatever is kept in memory."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.training.targets import Targets

WHITE = torch.ones(3)


@dataclass
class Picture:
    """A view that counts how often it is read."""

    values: Tensor
    reads: int = 0
    color: float = 1.0

    @property
    def camera(self) -> Cameras:
        height, width = self.values.shape[:2]
        K = torch.tensor([[9.0, 0, width / 2], [0, 9.0, height / 2], [0, 0, 1]], dtype=torch.float64)
        return Cameras(torch.eye(4, dtype=torch.float64)[None], K[None], width, height)

    def pixels(self) -> Tensor:
        self.reads += 1
        return self.values

    def inverse_depths(self, height: int, width: int) -> None:
        """No map."""


def pictures(channels: int, count: int = 3, height: int = 6, width: int = 10) -> list[Picture]:
    generator = torch.Generator().manual_seed(channels)
    shape = (height, width, channels)
    return [Picture(torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)) for _ in range(count)]


@pytest.mark.parametrize("background", [torch.ones(3), torch.zeros(3), torch.tensor([0.2, 0.5, 0.9])])
@pytest.mark.parametrize("fixed", [True, False])
def test_straight_alpha_over_the_background(background: Tensor, fixed: bool) -> None:
    views = pictures(4)
    targets = Targets(views, background if fixed else None, budget=10**6)
    rgba = views[1].values.double() / 255
    expected = rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:])
    for _ in range(2):  # read, then kept
        target = targets.get(1, 1, background)
        torch.testing.assert_close(target.colors.double(), expected, rtol=0, atol=1e-6)
        torch.testing.assert_close(target.alphas.double(), rgba[..., 3], rtol=0, atol=1e-6)
    assert views[1].reads == 1


def test_pictures_without_alpha_are_themselves_on_any_background() -> None:
    views = pictures(3)
    target = Targets(views, None, 10**6).get(0, 1, torch.tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(target.colors, views[0].values / 255)
    assert target.alphas is None


@pytest.mark.parametrize("budget", [0, 6 * 10 * 4 * 4 * 2, 10**6])
def test_memory_is_bounded_and_changes_nothing(budget: int) -> None:
    views = pictures(4)
    targets, reference = Targets(views, WHITE, budget), Targets(pictures(4), WHITE, 10**6)
    for index in (0, 1, 2, 0, 1, 2):
        assert torch.equal(targets.get(index, 1, WHITE).colors, reference.get(index, 1, WHITE).colors)
    held = min(3, budget // (6 * 10 * 4 * 4))
    assert [view.reads for view in views] == [1] * held + [2] * (3 - held)


def test_a_coarser_target_covers_the_same_field_of_view_and_keeps_the_mean() -> None:
    views = pictures(4, height=8, width=12)
    targets = Targets(views, WHITE, 10**6)
    full, half = targets.get(0, 1, WHITE), targets.get(0, 2, WHITE)
    assert half.colors.shape == (4, 6, 3)
    assert (half.camera.width, half.camera.height) == (6, 4)
    torch.testing.assert_close(half.camera.Ks[0, :2] * 2, full.camera.Ks[0, :2])
    torch.testing.assert_close(half.colors.mean((0, 1)), full.colors.mean((0, 1)))
    boxes = full.colors.unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2))
    torch.testing.assert_close(half.colors, boxes)
    assert torch.equal(targets.get(0, 1, WHITE).colors, full.colors)


def test_the_whole_image_and_its_window_are_made_at_once() -> None:
    """In either order: the file is read once, and what was kept is the same record."""
    for first in (False, True):
        view = pictures(4, 1, 80, 96)[0]
        view.values[:, 48:] = 0
        targets = Targets([view], WHITE, 10**6)
        got = {whole: targets.get(0, 1, WHITE, whole=whole) for whole in (first, not first)}
        window, entire = got[False], got[True]
        assert entire.colors.shape == (80, 96, 3)
        assert torch.equal(window.colors, entire.colors[:, :64])
        assert view.reads == 1
        assert targets.get(0, 1, WHITE, whole=False) is window


def test_an_image_without_a_smaller_window_is_kept_once() -> None:
    """Two of these fill the budget, although each is asked for both ways."""
    views = pictures(4, 2)
    for view in views:
        view.values[..., 3] = 255
    targets = Targets(views, WHITE, 6 * 10 * 4 * 4 * 2)
    for _ in range(2):
        for index in (0, 1):
            assert targets.get(index, 1, WHITE, whole=False) is targets.get(index, 1, WHITE)
    assert [view.reads for view in views] == [1, 1]
