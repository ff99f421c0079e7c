"""The order of points along a Z curve."""

from __future__ import annotations

import pytest
import torch

from gsopt.geometry.morton import BITS, morton_order


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


def test_neighbors_in_memory_are_neighbors_in_space() -> None:
    means = torch.rand(4096, 3, generator=torch.Generator().manual_seed(1))
    ordered = means[morton_order(means)]
    steps, random_steps = ((x[1:] - x[:-1]).norm(dim=1).mean() for x in (ordered, means))
    assert steps < 0.2 * random_steps


def test_morton_order_walks_the_octants_in_turn() -> None:
    """All of an octant comes before any of the next, z deciding first, then y, then x; and so on inside."""
    points = 2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 1
    points[:2] = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    order = morton_order(points)
    assert sorted(order.tolist()) == list(range(500))
    octant = ((points > 0).long() @ torch.tensor([1, 2, 4]))[order]
    assert bool((octant.diff() >= 0).all())


def test_morton_order_keeps_ties_and_bears_flat_clouds() -> None:
    assert morton_order(torch.zeros(5, 3)).tolist() == [0, 1, 2, 3, 4]
    line = torch.tensor([[0.0, 3, 0], [0, 1, 0], [0, 2, 0]])
    assert morton_order(line).tolist() == [1, 2, 0]
