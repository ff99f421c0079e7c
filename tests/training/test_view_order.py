"""The order of views and of random numbers."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.training.view_order import ViewOrder, generators


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
