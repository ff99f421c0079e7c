"""Floaters are found by the distance to their neighbors, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_scenes import cloud, ring

from gsopt.gaussians import Gaussians
from gsopt.geometry.morton import morton_order
from gsopt.raster.api import make_backend
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


@pytest.mark.parametrize(("opening", "removed"), [(0.0, True), (0.05, True), (0.0501, False)])
def test_a_solitary_gaussian_that_an_input_view_needs_is_no_floater(
    opening: float, removed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians = cloud(100, seed=2)
    means = gaussians.means.clone()
    means[7] = 50.0
    gaussians = replace(gaussians, means=means)

    def openings(given: Gaussians, alone: torch.Tensor, *views: object, antialiased: bool) -> torch.Tensor:
        assert given is gaussians
        assert alone.nonzero().flatten().tolist() == [7]
        assert antialiased
        return torch.where(alone, opening, 1.0)

    monkeypatch.setattr(floaters, "openings", openings)
    found = floaters.floaters(gaussians, 4.0, [], make_backend("cpu"), antialiased=True)
    assert found.nonzero().flatten().tolist() == [7] * removed


@pytest.mark.parametrize("count", [1, 3])
def test_haze_is_what_is_faint_and_close_to_any_camera(count: int) -> None:
    around = ring(count, 0.0)
    cameras = [around[index] for index in range(count)]
    last = cameras[-1].centers[0].float()
    aside = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9]), dim=0)
    means = last + torch.tensor([[0.1], [0.49], [0.51], [0.1], [0.49]]) * aside
    opacities = torch.tensor([0.05, 0.099, 0.05, 0.101, 0.9])
    gaussians = replace(cloud(5, seed=1), means=means, logit_opacities=opacities.logit())
    assert floaters.haze(gaussians, cameras, 0.5).tolist() == [True, True, False, False, False]
    assert floaters.haze(gaussians, cameras, 0.2).tolist() == [True, False, False, False, False]


def test_a_rod_that_one_view_shows_stays_and_dust_before_a_ball_goes() -> None:
    """Both lie as far from the ball: ten along a rod to its side, ten in a row before it."""
    ball = 0.3 * torch.nn.functional.normalize(blob(500), dim=1)
    camera = ring(1, 0.0)[0]
    toward = torch.nn.functional.normalize(camera.centers[0].float(), dim=0)
    aside = torch.nn.functional.normalize(torch.linalg.cross(toward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    far = torch.linspace(0.9, 1.2, 10)[:, None]
    means = torch.cat([ball, far * aside, far * toward])
    base = cloud(len(means), seed=1)
    scales = torch.cat([torch.full((500, 3), 0.08), torch.full((10, 3), 0.05), torch.full((10, 3), 0.01)])
    opaque = torch.full((len(means),), 4.0)
    gaussians = replace(base, means=means, log_scales=scales.log(), logit_opacities=opaque)
    alone = solitary(means, 2.0)
    assert alone[500:].all()
    assert not alone[:500].any()
    found = floaters.floaters(gaussians, 2.0, [camera], make_backend("cpu"), antialiased=False)
    assert not found[:510].any()
    assert found[510:].all()
