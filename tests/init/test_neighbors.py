"""Nearest-neighbor distances against all pairs in float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.init import neighbors
from gsopt.init.neighbors import mean_neighbor_distance, nearest_distances


def all_pairs(points: torch.Tensor, k: int) -> torch.Tensor:
    gaps = (points[:, None].double() - points[None].double()).norm(dim=-1)
    return gaps.fill_diagonal_(float("inf")).topk(k, largest=False).values


def cloud(kind: str, count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator)
    if kind == "line":
        points[:, 1:] = 0
    if kind == "clusters":
        points = points * 1e-3 + torch.randint(0, 3, (count, 1), generator=generator)
    if kind == "outliers":
        points[: count // 20] *= 1e3
    if kind == "heavy tails":
        points = points**5
    return points


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["normal", "line", "clusters", "outliers", "heavy tails"]),
    st.integers(2, 700),
    st.integers(1, 4),
    st.integers(0, 1000),
)
def test_distances_are_those_of_all_pairs(kind: str, count: int, k: int, seed: int) -> None:
    points = torch.unique(cloud(kind, count, seed), dim=0)
    k = min(k, len(points) - 1)
    got, want = nearest_distances(points, k).double(), all_pairs(points, k)
    assert bool((got - want).abs().max() <= 1e-6 * points.abs().max() + 1e-12)
    assert bool((got[:, 1:] >= got[:, :-1]).all())


def test_a_tight_cluster_beside_lone_points() -> None:
    points = torch.cat([cloud("normal", 3000, 0) * 1e-5, cloud("normal", 40, 1) * 1e3])
    assert torch.allclose(nearest_distances(points, 3).double(), all_pairs(points, 3), rtol=1e-5, atol=1e-9)


def test_points_on_top_of_each_other_are_one_place() -> None:
    points = cloud("normal", 50, 2)
    doubled = torch.cat([points, points, points[:7]])
    once = mean_neighbor_distance(points)
    assert torch.allclose(mean_neighbor_distance(doubled), torch.cat([once, once, once[:7]]), rtol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 100])
def test_distances_are_positive_and_finite_for_few_or_equal_points(count: int) -> None:
    for points in (torch.zeros(count, 3), torch.full((count, 3), 1e6), cloud("normal", count, 0)):
        got = mean_neighbor_distance(points)
        assert got.shape == (count,)
        assert bool((got > 0).all())
        assert bool(got.isfinite().all())


def test_points_all_but_on_top_of_each_other_keep_a_thousandth_of_the_median() -> None:
    points = torch.cat([cloud("normal", 200, 4), 1e-7 * cloud("normal", 5, 5)])
    got = mean_neighbor_distance(points)
    assert float(nearest_distances(points, 3).mean(1)[200:].max()) < 1e-5
    assert torch.allclose(got[200:], 1e-3 * got.median(), rtol=1e-5)
    assert float(got.min()) >= 0.999e-3 * float(got.median())


def test_distances_scale_with_the_points_and_ignore_where_they_are() -> None:
    points = cloud("normal", 300, 3)
    base = mean_neighbor_distance(points)
    assert torch.allclose(mean_neighbor_distance(points * 64), base * 64, rtol=1e-5)
    assert torch.allclose(mean_neighbor_distance(points + 8), base, rtol=1e-3)
    shuffled = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(mean_neighbor_distance(points[shuffled]), base[shuffled], rtol=1e-6)


def test_leaves_that_hold_nothing_but_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbors, "LEAF_POINTS", 4)
    monkeypatch.setattr(neighbors, "_LEAVES_AT_ONCE", 1)
    points = torch.rand(49, 3, generator=torch.Generator().manual_seed(0))
    distances = torch.cdist(points.double(), points.double()).fill_diagonal_(torch.inf)
    expected = distances.topk(3, largest=False).values
    torch.testing.assert_close(neighbors.nearest_distances(points, 3).double(), expected, rtol=1e-4, atol=1e-6)


def test_the_mean_is_taken_over_three_neighbors() -> None:
    places = torch.tensor([0.0, 1, 3, 7, 15])
    points = torch.stack([places, torch.zeros(5), torch.zeros(5)], dim=1)
    expected = torch.tensor([1 + 3 + 7, 1 + 2 + 6, 2 + 3 + 4, 4 + 6 + 7, 8 + 12 + 14]) / 3
    torch.testing.assert_close(mean_neighbor_distance(points), expected)
    torch.testing.assert_close(mean_neighbor_distance(points, 1), torch.tensor([1.0, 1, 2, 4, 8]))
