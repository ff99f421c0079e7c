"""Merging keeps the place, size, color and mass of splats, gives as many as asked for, and its cost is printed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from finished_runs import make_run, ring, splats

from gsopt.cli import main
from gsopt.formats import load_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import normalize, rotation_matrices
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results.decimate import _costs, decimated, masses, merged


def many(count: int = 200) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    cloud = splats(count)
    scales = -2 + torch.rand(count, 3, generator=generator)
    return Gaussians(cloud.means, cloud.quats, scales, cloud.logit_opacities, cloud.sh0, torch.zeros(count, 3, 3))


def covariances(gaussians: Gaussians) -> torch.Tensor:
    turns = rotation_matrices(normalize(gaussians.quats.double())) * gaussians.scales.double()[:, None]
    return turns @ turns.mT


@pytest.mark.parametrize("share", [1.0, 0.5, 0.25, 0.013, 1e-6])
def test_as_many_are_left_as_asked_for_and_all_can_be_drawn(share: float) -> None:
    found = decimated(many(), share)
    assert len(found) == max(1, round(share * 200))
    found.validate()
    assert torch.equal(found.means, decimated(many(), share).means)


def test_a_merged_pair_keeps_mean_covariance_and_color() -> None:
    """The first two moments of the weighted mixture, by their definition."""
    pair = many(2)
    one = merged(pair, torch.tensor([[0, 1]]))
    weight = masses(pair) / masses(pair).sum()
    mean = (weight[:, None] * pair.means.double()).sum(0)
    second = covariances(pair) + pair.means.double()[:, :, None] * pair.means.double()[:, None, :]
    assert torch.allclose(one.means[0].double(), mean, atol=1e-6)
    expected = (weight[:, None, None] * second).sum(0) - mean[:, None] * mean[None, :]
    assert torch.allclose(covariances(one)[0], expected, atol=1e-5)
    assert torch.allclose(one.sh0[0].double(), (weight[:, None, None] * pair.sh0.double()).sum(0), atol=1e-6)


def test_a_splat_that_lies_there_twice_becomes_one_of_its_shape() -> None:
    twice = splats(1).append(splats(1))
    one = decimated(twice, 0.5)
    assert torch.allclose(one.means, twice.means[:1], atol=1e-6)
    assert torch.allclose(covariances(one), covariances(twice)[:1], atol=1e-5)
    assert float(one.opacities[0]) > float(twice.opacities[0])


def test_what_is_alike_is_merged_before_what_differs() -> None:
    """Two near splats of one color and a far one of another: the near ones become one."""
    cloud = splats(3)
    means = torch.tensor([[0.0, 0, 0], [0.01, 0, 0], [2.0, 2, 2]])
    cloud = Gaussians(means, cloud.quats, torch.full((3, 3), math.log(0.1)), *list(dict(cloud.items()).values())[3:])
    found = decimated(cloud, 0.67)
    assert sorted(round(float(x), 2) for x in found.means[:, 1]) == [0.0, 2.0]


def test_a_dense_cloud_looks_the_same_with_half_of_it() -> None:
    cloud, shot = many(400), ring(2)[0]
    full, half = (
        ReferenceBackend().forward(c, shot, RasterSettings(sh_degree=0)).alphas for c in (cloud, decimated(cloud, 0.5))
    )
    assert float((full - half).abs().mean()) < 0.05


def test_the_command_prints_what_it_costs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out = make_run(tmp_path), tmp_path / "a.ply"
    assert main(["export", str(run), "-o", str(out), "--decimate", "50%"]) == 0
    text = capsys.readouterr().out
    assert "input views: " in text
    assert "held-out views: " in text
    assert "with 50% of the splats " in text
    assert len(load_splats(out)) == 6
    assert main(["export", str(out), "-o", str(tmp_path / "b.spz"), "--decimate", "50%"]) == 0
    assert len(load_splats(tmp_path / "b.spz")) == 3


def test_what_views_hardly_see_goes_first() -> None:
    """More of the splats that are seen stay as they are than without views, and fewer of those that are not."""
    cloud = many(100)
    seen = torch.where(torch.arange(100) < 60, 0.0, 50.0)
    found = decimated(cloud, 0.4, seen)
    assert len(found) == 40
    unseen, seen_ones = ({tuple(row) for row in part.tolist()} for part in (cloud.means[:60], cloud.means[60:]))
    left, without = ({tuple(row) for row in c.means.tolist()} for c in (found, decimated(cloud, 0.4)))
    assert len(left & seen_ones) > len(without & seen_ones)
    assert len(left & unseen) < len(without & unseen)
    assert torch.equal(found.means, decimated(cloud, 0.4, seen).means)
    assert len(decimated(cloud, 1e-6, torch.zeros(100))) == 1


@pytest.mark.parametrize("text", ["0%", "-5%", "101%", "25", "x%", "nan%", ""])
def test_a_share_that_is_none_is_refused_in_one_line(tmp_path: Path, capsys, text: str) -> None:
    assert main(["export", str(make_run(tmp_path)), "-o", str(tmp_path / "a.ply"), f"--decimate={text}"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "a.ply").exists()


def test_a_mass_is_opacity_times_the_area_of_the_two_longest_axes() -> None:
    cloud = splats(1)
    cloud = replace(cloud, log_scales=torch.tensor([[0.5, 2.0, 3.0]]).log(), logit_opacities=torch.zeros(1))
    assert float(masses(cloud)[0]) == pytest.approx(0.5 * 2 * 3)
    for order in ([2, 0, 1], [1, 2, 0]):
        assert float(masses(replace(cloud, log_scales=cloud.log_scales[:, order]))[0]) == pytest.approx(3)


def test_a_pair_costs_the_weight_that_moves_times_its_distance_and_color() -> None:
    """Weights 2 and 6 reduce to 12 / 8; variances of 0.04 and 0.09; colors (unit sh0) count one half."""
    pair = splats(2)
    means, color = torch.tensor([[0.0, 0, 0], [0.3, 0.4, 0]]), torch.tensor([[[0.0, 0, 0]], [[1.0, 2, 2]]])
    scales = torch.tensor([[0.2] * 3, [0.3] * 3]).log()
    pair = replace(pair, means=means, sh0=color, log_scales=scales)
    found = _costs(pair, torch.tensor([2.0, 6.0]).double(), torch.tensor([[0, 1]]))
    assert float(found[0]) == pytest.approx(1.5 * (0.25 / 0.13 + 0.5 * 9), rel=1e-5)
    tiny = replace(pair, log_scales=scales - 20)
    found = _costs(tiny, torch.tensor([2e-20, 6e-20]).double(), torch.tensor([[0, 1]]))
    assert float(found[0]) == pytest.approx(1.5e-20 * 0.25 / 0.13 * math.exp(40), rel=1e-4)


def test_half_of_what_goes_is_what_contributes_least() -> None:
    """Of 40 that go from a hundred, the 20 of least contribution leave no trace."""
    cloud = many(100)
    far = replace(cloud, means=cloud.means + torch.arange(100)[:, None] * 1000.0)
    weights = torch.arange(100).float() + 1
    found = decimated(far, 0.6, weights)
    assert len(found) == 60
    rows = (found.means[:, 0] / 1000).round()
    assert float(rows.min()) >= 19.5
    assert len(decimated(far, 1.0, weights)) == 100


def test_a_merged_splat_has_a_true_rotation_and_keeps_opacity_times_area() -> None:
    cloud = many(40)
    one = merged(cloud, torch.arange(40).view(20, 2))
    assert torch.allclose(one.quats.norm(dim=1), torch.ones(20), atol=1e-5)
    pairs = masses(cloud).view(20, 2).sum(1)
    longest = one.scales.double().sort(dim=1).values
    expected = (pairs / (longest[:, 1] * longest[:, 2])).clamp(max=0.995)
    torch.testing.assert_close(one.opacities.double(), expected, rtol=1e-4, atol=0)
    moments = cloud.means.double().view(20, 2, 3)
    share = (masses(cloud) / pairs.repeat_interleave(2)).view(20, 2, 1)
    mean = (share * moments).sum(1)
    second = covariances(cloud).view(20, 2, 3, 3) + moments[..., :, None] * moments[..., None, :]
    expected = (share[..., None] * second).sum(1) - mean[:, :, None] * mean[:, None, :]
    torch.testing.assert_close(covariances(one), expected, rtol=1e-3, atol=1e-4)
