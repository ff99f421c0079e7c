"""The parts of a mask's repair: connected parts, histograms of colors, and what is said of it."""

from __future__ import annotations

import pytest
import torch

from gsopt.init.mask_parts import cleaned, labels, touched
from gsopt.init.mask_repair import RepairedMask, _bins, _enlarged, _histogram


@pytest.mark.parametrize(("hole", "filled"), [(10, True), (11, False)])
def test_a_hole_of_two_percent_is_filled_and_a_larger_one_is_not(hole: int, filled: bool) -> None:
    """A mask of 500 or 499 pixels."""
    mask = torch.zeros(21, 34, dtype=torch.bool)
    mask[2:19, 2:32] = True
    mask[5, 5 : 5 + hole] = False
    assert int(mask.sum()) == 510 - hole
    found = cleaned(mask)
    assert int(found.sum()) == (510 if filled else 510 - hole)


def test_a_notch_at_the_border_of_the_image_is_no_hole() -> None:
    whole = torch.ones(20, 30, dtype=torch.bool)
    for row, column in ((0, 4), (19, 4), (4, 0), (4, 29)):
        mask = whole.clone()
        mask[row, column] = False
        assert torch.equal(cleaned(mask), mask)
    inner = whole.clone()
    inner[1, 1] = False
    assert torch.equal(cleaned(inner), whole)


def test_parts_that_touch_at_a_corner_are_one() -> None:
    mask = torch.zeros(9, 9, dtype=torch.bool)
    mask[1:3, 1:3] = mask[3:5, 3:5] = True
    mask[6:8, 0:3] = True
    found = labels(mask)
    assert found[1, 1] == found[4, 4]
    assert found[6, 0] not in (0, int(found[1, 1]))
    assert torch.equal(found > 0, mask)
    assert int(cleaned(mask).sum()) == 8


def test_parts_with_a_seed_are_kept_whole() -> None:
    """A bent part with a seed at one end, another whose seed lies beside it, and a third that touches at a corner."""
    mask = torch.zeros(9, 12, dtype=torch.bool)
    mask[0, 0:8] = mask[0:9, 7] = mask[8, 0:8] = True
    mask[3:5, 2:4] = True
    mask[2, 8] = True
    seeds = torch.zeros_like(mask)
    seeds[0, 0] = seeds[4, 5] = True
    expected = mask.clone()
    expected[3:5, 2:4] = False
    assert torch.equal(touched(mask, seeds), expected)
    assert torch.equal(touched(mask, mask), mask)
    assert not bool(touched(mask, torch.zeros_like(mask)).any())


def test_colors_fall_into_sixteen_bins_along_each_channel() -> None:
    colors = torch.tensor([[0, 0, 0], [15, 15, 15], [16, 0, 0], [0, 16, 0], [0, 0, 16], [255, 255, 255]])
    assert _bins(colors.to(torch.uint8)).tolist() == [0, 0, 256, 16, 1, 4095]


def test_a_histogram_is_spread_over_neighbors_and_nowhere_zero() -> None:
    """54 pixels give 2 to each of 27 bins; every one of 4096 bins has 1/32 more, 128 in all."""
    found = _histogram(torch.full((54, 3), 100, dtype=torch.uint8)).view(16, 16, 16)
    assert float(found.sum()) == pytest.approx(1)
    assert float(found[6, 6, 6]) == pytest.approx((2 + 1 / 32) / (54 + 128))
    assert float(found[5, 7, 6]) == pytest.approx((2 + 1 / 32) / (54 + 128))
    assert float(found[4, 6, 6]) == pytest.approx((1 / 32) / (54 + 128))


def test_a_mask_is_enlarged_with_soft_edges() -> None:
    found = _enlarged(torch.tensor([[True, False]]), 1, 4)
    assert found.tolist() == [[255, 191, 64, 0]]


@pytest.mark.parametrize(("kind", "share"), [("lost", True), ("too large", True), ("missing", False), ("empty", False)])
def test_only_a_mask_that_shows_something_has_a_covered_share(kind: str, share: bool) -> None:
    mask = RepairedMask("r_1.png", kind, 0.43219, "hull")
    assert ("covers 43% of it" in mask.about) == share
    assert "r_1.png disagrees" in mask.about
    assert mask.to_dict() == {"name": "r_1.png", "kind": kind, "covered": 0.4322, "repair": "hull"}
