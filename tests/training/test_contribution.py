"""Laws of what Gaussians add to the input views, and of those that make room for growth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tiny_scenes import cloud, ring

from gsopt.config.train import DensityConfig, TrainConfig
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings
from gsopt.training import plan
from gsopt.training.density import contribution
from gsopt.training.density.contribution import contributions, least, openings
from gsopt.training.open_settings import MANY


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_all_contributions_add_up_to_the_alphas_of_all_views(backend: str) -> None:
    gaussians, cameras, drawn_by = cloud(30, seed=3), ring(4, 1.0), make_backend(backend)
    found = contributions(gaussians, [cameras[i] for i in range(4)], drawn_by, antialiased=False)
    alphas = [drawn_by.forward(gaussians, cameras[i], RasterSettings()).alphas.sum() for i in range(4)]
    torch.testing.assert_close(found.sum(), torch.stack(alphas).sum(), rtol=1e-4, atol=1e-4)
    assert bool((found >= 0).all())


def test_the_color_of_a_gaussian_does_not_matter() -> None:
    gaussians, cameras = cloud(30, seed=3), [ring(2, 1.0)[0]]
    black = replace(gaussians, sh0=torch.full_like(gaussians.sh0, -9.0))
    found = [contributions(one, cameras, make_backend("cpu"), antialiased=False) for one in (gaussians, black)]
    assert torch.equal(*found)


def test_what_lies_behind_others_adds_next_to_nothing() -> None:
    """Ten opaque ones on the line to the only camera: the farthest adds less than all others."""
    row, camera = on_a_line(torch.linspace(0.5, -0.5, 10).tolist(), [3.0] * 10)
    found = contributions(row, [camera], make_backend("cpu"), antialiased=False)
    assert found.argmax() == 0
    assert least(found, 0.1).nonzero().flatten().tolist() == [9]


def test_no_more_views_are_looked_at_than_needed_evenly_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians, cameras = cloud(20, seed=5), ring(6, 1.0)
    monkeypatch.setattr(contribution, "MAX_VIEWS", 3)
    backend = make_backend("cpu")
    found = contributions(gaussians, [cameras[i] for i in range(6)], backend, antialiased=False)
    wanted = contributions(gaussians, [cameras[i] for i in (0, 2, 4)], backend, antialiased=False)
    assert torch.equal(found, wanted)


def on_a_line(places: list[float], logits: list[float]) -> tuple[Gaussians, Cameras]:
    """Gaussians between the origin and one camera, and the camera."""
    camera, count = ring(1, 0.0)[0], len(places)
    toward = camera.centers[0].float() / camera.centers[0].float().norm()
    base = cloud(count, seed=1)
    row = replace(
        base,
        means=torch.tensor(places)[:, None] * toward,
        log_scales=torch.full((count, 3), math.log(0.1)),
        logit_opacities=torch.tensor(logits),
    )
    return row, camera


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_what_stands_alone_opens_what_it_covers_and_what_stands_before_another_does_not(backend: str) -> None:
    alone, camera = on_a_line([0.3], [6.0])
    covered, _ = on_a_line([0.3, 0.0], [6.0, 9.0])
    backed = replace(covered, log_scales=torch.tensor([0.05, 0.6]).log()[:, None].expand(2, 3).contiguous())
    drawn_by, first = make_backend(backend), torch.tensor([True, False])
    hole = openings(alone, first[:1], [camera], drawn_by, antialiased=False)
    frame = drawn_by.forward(alone, camera, RasterSettings(sh_degree=0))
    expected = frame.alphas.double().square().sum() / frame.alphas.double().sum()  # one splat: T alpha is alpha
    torch.testing.assert_close(hole[0].double(), expected, rtol=1e-4, atol=1e-5)
    kept = openings(backed, first, [camera], drawn_by, antialiased=False)
    assert float(kept[0]) < 0.02 < 0.5 < float(hole[0])


def test_what_no_view_shows_and_what_takes_nothing_away_opens_nothing() -> None:
    gaussians, cameras = cloud(30, seed=3), ring(2, 1.0)
    behind = replace(gaussians, means=gaussians.means + 100 * cameras[0].centers[0].float())
    every, none = torch.ones(30, dtype=torch.bool), torch.zeros(30, dtype=torch.bool)
    backend = make_backend("cpu")
    assert openings(behind, every, [cameras[0]], backend, antialiased=False).tolist() == [0.0] * 30
    assert openings(gaussians, none, [cameras[0]], backend, antialiased=False).tolist() == [0.0] * 30
    assert float(openings(gaussians, every, [cameras[0]], backend, antialiased=False).max()) > 0.05


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.25, 2), (0.9, 7), (1.0, 7)])
def test_the_lowest_go_first_in_row_order_and_one_always_stays(share: float, count: int) -> None:
    values = torch.tensor([3.0, 0.0, 5.0, 1.0, 1.0, 9.0, 2.0, 4.0])
    gone = least(values, share)
    order = [1, 3, 4, 6, 0, 7, 2]
    assert set(gone.nonzero().flatten().tolist()) == set(order[:count])


def test_room_is_made_three_times_in_the_second_half_of_refinement() -> None:
    config = TrainConfig()
    schedule = plan.make_schedule(config, config.iterations, MANY, extent=1.0, pixels=1.0)
    due = [step for step in range(1, config.iterations + 1) if schedule.turns_over(step)]
    assert schedule.refine_stop == 2400
    assert due == [1200, 1600, 2000]


def test_only_adc_makes_room() -> None:
    adc = DensityConfig(turnover=0.2)
    assert plan.density_plan(adc, 100, MANY, 1.0).turnover == 0.2
    assert plan.density_plan(replace(adc, strategy="mcmc"), 100, MANY, 1.0).turnover == 0


def test_twenty_five_views_are_looked_at_where_there_are_more() -> None:
    """Of 26 the last is left out; the same 25 alone give the same."""
    gaussians, cameras = cloud(5, seed=5), ring(26, 1.0)
    backend = make_backend("cpu")
    every = [cameras[i] for i in range(26)]
    found = contributions(gaussians, every, backend, antialiased=False)
    assert torch.equal(found, contributions(gaussians, every[:25], backend, antialiased=False))
    assert not torch.equal(found, contributions(gaussians, every[:24], backend, antialiased=False))
