"""Floaters are found by the distance to their neighbors, and nothing else is."""

from __future__ import annotations

import pytest
import torch

from gsopt.geometry.morton import morton_order
from gsopt.training import floaters
from gsopt.training.floaters import neighbor_distances, solitary


def blob(count: int, seed: int = 0) -> torch.Tensor:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return points[morton_order(points)]


def test_a_gaussian_far_from_all_others_is_a_floater_and_the_bulk_is_not() -> None:
    means = torch.cat([blob(500), torch.tensor([[30.0, 0, 0], [0, -40.0, 0]])])
    found = solitary(means, sigmas=4.0)
    assert found[-2:].tolist() == [True, True]
    assert not found[:-2].any()


def test_where_nothing_stands_out_nothing_is_found() -> None:
    circle = torch.linspace(0, 2 * torch.pi, 513)[:-1]
    means = torch.stack([circle.cos(), circle.sin(), torch.zeros(512)], dim=1)
    assert not solitary(means, sigmas=2.0).any()


@pytest.mark.parametrize("count", [0, 1, floaters.MIN_GAUSSIANS - 1])
def test_few_gaussians_have_no_floaters(count: int) -> None:
    means = 100 * blob(count)
    assert not solitary(means, sigmas=0.0).any()
    assert len(solitary(means, sigmas=0.0)) == count


def test_distances_are_those_to_the_nearest_others() -> None:
    means = blob(400)
    distances = torch.cdist(means.double(), means.double()) + torch.diag(torch.full((400,), torch.inf))
    expected = distances.topk(20, largest=False).values.mean(dim=1)  # √400 neighbors
    torch.testing.assert_close(neighbor_distances(means), expected.float(), rtol=1e-4, atol=1e-5)


def test_a_sample_of_references_gives_about_the_same_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    means = blob(3000)
    sampled = neighbor_distances(means)
    monkeypatch.setattr(floaters, "MAX_REFERENCES", len(means))
    exact = neighbor_distances(means)
    assert float((sampled / exact).log().mean().abs()) < 0.1
    assert torch.corrcoef(torch.stack([sampled.log(), exact.log()]))[0, 1] > 0.9


def test_distances_do_not_depend_on_the_frame() -> None:
    means = blob(300)
    turned = means[:, [1, 2, 0]] * torch.tensor([-1.0, 1.0, -1.0]) + 5.0
    torch.testing.assert_close(neighbor_distances(turned), neighbor_distances(means), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("farthest", "found"), [(1005.0, False), (1040.0, False), (1041.0, True)])
def test_where_nearly_all_are_alike_a_deviation_is_a_hundredth_of_the_mean(
    farthest: float, found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 63 at 1000 and one farther out the true deviation is an eighth of what it stands out by."""
    distances = torch.full((64,), 1000.0)
    distances[5] = farthest
    monkeypatch.setattr(floaters, "neighbor_distances", lambda means: distances)
    assert solitary(torch.zeros(64, 3), sigmas=4.0).nonzero().flatten().tolist() == [5] * found
