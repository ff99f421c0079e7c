"""The farthest-point selection."""

from __future__ import annotations

import torch

from gsopt.geometry.farthest_points import farthest_points


def test_farthest_points_start_at_the_middle_and_each_is_the_farthest_from_those_before() -> None:
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    chosen = farthest_points(points, 12)
    assert chosen[0] == int((points - points.mean(0)).norm(dim=1).argmin())
    gaps = torch.cdist(points, points)
    for i in range(1, 12):
        assert chosen[i] == int(gaps[:, chosen[:i]].amin(dim=1).argmax())


def test_farthest_points_do_not_depend_on_order_and_are_nested() -> None:
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    chosen = farthest_points(points, 9)
    assert farthest_points(points, 5) == chosen[:5]
    shuffled = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    assert [int(shuffled[i]) for i in farthest_points(points[shuffled], 9)] == chosen


def test_cameras_in_one_place_are_chosen_once_each() -> None:
    assert farthest_points(torch.zeros(5, 3, dtype=torch.float64), 5) == [0, 1, 2, 3, 4]
