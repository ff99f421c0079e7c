"""The order of views, of random numbers and of Gaussians in memory."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.training.morton import BITS, morton_order
from gsopt.training.order import ViewOrder, generators


@settings(max_examples=50, deadline=None)
@given(views=st.integers(1, 20), seed=st.integers(0, 1000))
def test_every_epoch_sees_every_view_once(views: int, seed: int) -> None:
    order = ViewOrder(views, generators(seed)["views"])
    for _ in range(3):
        assert sorted(order.next() for _ in range(views)) == list(range(views))


def test_mirror_images_take_turns_among_the_views() -> None:
    order = ViewOrder(4, generators(3)["views"], images=12, images_per_epoch=5)
    epochs = [[order.next() for _ in range(9)] for _ in range(20)]
    for epoch in epochs:
        assert sorted(row for row in epoch if row < 4) == [0, 1, 2, 3]
        assert len(set(epoch)) == 9
    assert {row for epoch in epochs for row in epoch} == set(range(16))


def test_epochs_are_shuffled_anew() -> None:
    order = ViewOrder(30, generators(0)["views"])
    first, second = ([order.next() for _ in range(30)] for _ in range(2))
    assert first != second != sorted(second)


def test_no_two_purposes_or_seeds_share_their_numbers() -> None:
    draws = [tuple(torch.rand(4, generator=g).tolist()) for seed in range(5) for g in generators(seed).values()]
    assert len(set(draws)) == len(draws)


def interleaved(point: list[int]) -> int:
    return sum(((value >> bit) & 1) << (3 * bit + axis) for axis, value in enumerate(point) for bit in range(BITS))


def test_morton_order_is_that_of_interleaved_bits() -> None:
    means = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low).double() / (high - low).double() * (2**BITS - 1)).long().tolist()
    codes = [interleaved(cell) for cell in cells]
    assert morton_order(means).tolist() == sorted(range(200), key=lambda row: codes[row])


@pytest.mark.parametrize("means", [torch.zeros(0, 3), torch.ones(5, 3), torch.tensor([[1e30, 0, 0], [-1e30, 0, 0]])])
def test_morton_order_is_a_permutation_of_anything_finite(means: torch.Tensor) -> None:
    assert sorted(morton_order(means).tolist()) == list(range(len(means)))


def test_neighbours_in_memory_are_neighbours_in_space() -> None:
    means = torch.rand(4096, 3, generator=torch.Generator().manual_seed(1))
    ordered = means[morton_order(means)]
    steps, random_steps = ((x[1:] - x[:-1]).norm(dim=1).mean() for x in (ordered, means))
    assert steps < 0.2 * random_steps
