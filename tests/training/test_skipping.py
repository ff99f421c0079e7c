"""Skipped work changes nothing that it must not change: windows, resting views, bands grown by the residual."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scenes import SIZE, cloud, ring, tiny_config
from torch import Tensor

from gsopt.config.train import DensityConfig, ScheduleConfig, SparseConfig
from gsopt.data.scene import load_scene
from gsopt.geometry import sh
from gsopt.init import first_gaussians
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.training.content_window import MARGIN, MAX_SHARE, TILE, Window, content_window
from gsopt.training.plan import RunPlan
from gsopt.training.skipping import Bands, Resting
from gsopt.training.targets import Target, cropped
from gsopt.training.trainer import Trainer


@settings(max_examples=60, deadline=None)
@given(height=st.integers(1, 90), width=st.integers(1, 90), data=st.data())
def test_a_window_holds_all_that_shows_and_its_margin(height: int, width: int, data: st.DataObject) -> None:
    alphas = torch.zeros(height, width)
    for _ in range(data.draw(st.integers(0, 3))):
        alphas[data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))] = 0.01
    window = content_window(alphas)
    if window is None:
        return
    assert (window.y1 - window.y0) * (window.x1 - window.x0) < MAX_SHARE * height * width
    assert window.y0 % TILE == window.x0 % TILE == 0
    for y, x in alphas.nonzero().tolist():
        assert window.y0 <= max(0, y - MARGIN) < min(height, y + 1 + MARGIN) <= window.y1
        assert window.x0 <= max(0, x - MARGIN) < min(width, x + 1 + MARGIN) <= window.x1


def test_nothing_to_crop_where_there_is_no_alpha_or_nothing_but_content() -> None:
    assert content_window(None) is None
    assert content_window(torch.zeros(64, 64)) is None
    assert content_window(torch.ones(64, 64)) is None


def big_ring() -> Target:
    """A camera of 96 x 80 px on a picture whose alpha shows something in one corner."""
    camera = ring(3, 0.5)[1].resized(96, 80).to(torch.float32)
    alphas = torch.zeros(80, 96)
    alphas[40:58, 50:60] = 1
    return Target(camera, torch.rand(80, 96, 3, generator=torch.Generator().manual_seed(0)), alphas, (80, 96))


def test_a_window_is_drawn_as_the_same_part_of_the_whole_image() -> None:
    whole = big_ring()
    part = cropped(whole)
    window = Window(16, 74, 32, 76)
    assert part.colors.shape == (58, 44, 3)
    assert part.share == pytest.approx(58 * 44 / (80 * 96))
    torch.testing.assert_close(part.colors, window.crop(whole.colors), rtol=0, atol=0)
    backend = make_backend("cpu", 1)
    gaussians = cloud(200, seed=3)
    # Small ones: for wide ones far outside, the projection is clamped to the window instead of the image.
    gaussians = replace(gaussians, log_scales=gaussians.log_scales - 1.5)
    frames = [backend.forward(gaussians, t.camera, RasterSettings(sh_degree=1), torch.ones(3)) for t in (whole, part)]
    torch.testing.assert_close(frames[1].colors, window.crop(frames[0].colors), rtol=0, atol=2e-5)
    torch.testing.assert_close(frames[1].alphas, window.crop(frames[0].alphas), rtol=0, atol=2e-5)


def test_where_the_rest_is_background_already_the_gradient_is_that_of_the_whole_image() -> None:
    backend = make_backend("cpu", 1)
    small = cloud(30, seed=3)
    small = replace(small, means=0.02 * small.means, log_scales=small.log_scales - 2)
    camera = ring(3, 0.0)[0].resized(112, 112).to(torch.float32)
    frame = backend.forward(small, camera, RasterSettings(sh_degree=1), torch.ones(3))
    shown = frame.alphas > 0
    noise = 0.2 * torch.rand(112, 112, 3, generator=torch.Generator().manual_seed(1))
    colors = torch.where(shown[..., None], frame.colors - noise, 1.0)
    whole = Target(camera, colors, shown.float(), (112, 112))

    def gradients(target: Target) -> Gradients:
        drawn = backend.forward(small, target.camera, RasterSettings(sh_degree=1), torch.ones(3))
        v_colors = backend.photometric(drawn.colors, target.colors, 0.2).v_colors
        return backend.backward(drawn, v_colors.mul_(target.share))

    part = cropped(whole)
    assert part.share < 0.6
    full, cut = gradients(whole), gradients(part)
    for name in ("means", "log_scales", "logit_opacities", "sh0", "means2d"):
        a, b = getattr(full, name), getattr(cut, name)
        assert float((a - b).norm() / a.norm()) < 1e-3, name


def test_a_view_rests_once_when_its_loss_has_stopped_falling() -> None:
    resting = Resting(2)
    resting.note(0, 1.0)
    assert not resting.skips(0)
    resting.note(0, 0.9)
    assert not resting.skips(0)
    resting.note(0, 0.895)
    assert not resting.skips(1)
    assert resting.skips(0)
    assert not resting.skips(0)


def residuals(views: int, dependent: bool) -> Bands:
    """Bands that watched residuals which do, or do not, follow the first band of a view's direction."""
    generator = torch.Generator().manual_seed(views)
    gaussians, cameras = cloud(400, seed=1), ring(views, 1.0).to(torch.float32)
    bands = Bands(every=views, highest=3)
    tilt = torch.randn(400, 3, generator=generator)
    for i in range(views):
        colors = torch.randn(400, 3, generator=generator)
        if dependent:
            directions = torch.nn.functional.normalize(gaussians.means - cameras[i].centers, dim=1)
            colors = colors + 4 * (directions * tilt).sum(dim=1, keepdim=True)
        nothing = torch.zeros(400, 1, 3)
        v = Gradients(nothing, nothing, nothing, nothing, sh.C0 * colors[:, None], nothing, nothing, None)
        assert bands.watches(i + 1)
        bands.note(gaussians, cameras[i], v)
    return bands


@pytest.mark.parametrize("views", [8, 40])
def test_a_band_is_drawn_where_the_residual_follows_it_and_not_where_it_is_noise(views: int) -> None:
    noise, signal = residuals(views, dependent=False), residuals(views, dependent=True)
    assert noise.ratio() == pytest.approx(1, abs=0.2)
    assert signal.ratio() > 3
    for bands, degree in ((noise, 0), (signal, 1)):
        bands.decide(views)
        assert bands.degree == degree
        assert bands.ratio() == 0


def test_a_resumed_decision_about_bands_is_the_one_of_the_run_that_never_stopped() -> None:
    bands, resumed = residuals(8, dependent=True), Bands(every=8, highest=3)
    resumed.restore(bands.tensors(), 400, torch.device("cpu"))
    assert resumed.ratio() == bands.ratio() > Bands.LEAST_RATIO
    for one in (bands, resumed):
        one.decide(8)
    assert resumed.degree == bands.degree == 1


def test_one_view_decides_nothing() -> None:
    assert residuals(1, dependent=True).ratio() == 0


def test_residuals_without_any_scatter_decide_nothing() -> None:
    """One camera twice, with the same gradient: chance explains nothing, and nothing is divided by it."""
    gaussians, cameras = cloud(5, seed=1), ring(2, 1.0).to(torch.float32)
    bands, nothing = Bands(every=2, highest=3), torch.zeros(5, 1, 3)
    for _ in range(2):
        v = Gradients(nothing, nothing, nothing, nothing, torch.ones(5, 1, 3), nothing, nothing, None)
        bands.note(gaussians, cameras[0], v)
    assert bands.ratio() == 0


def test_bands_are_watched_just_before_they_are_due() -> None:
    bands = Bands(every=1000, highest=1)
    assert [bands.watches(step) for step in (1, 900, 901, 1000, 1001)] == [False, False, True, True, False]
    bands.degree = 1
    assert not bands.watches(1000)


def passed_steps(dataset: Path, schedule: ScheduleConfig) -> tuple[int, list[float], Tensor]:
    """Number of 30 steps that computed nothing, all losses, and the last means."""
    config = tiny_config(
        dataset,
        schedule=schedule,
        density=DensityConfig(refine_start=4, refine_every=5, refine_stop=10, max_gaussians=90),
        sparse=SparseConfig(below_views=0),
    )
    scene = load_scene(config.data)
    gaussians, _ = first_gaussians(scene, config.init, 3, 0)
    trainer = Trainer(RunPlan.of(config, scene), scene, gaussians, make_backend("cpu", 1))
    before, unmoved, losses = trainer.model.gaussians.means.clone(), 0, []
    for _ in range(30):
        losses.append(trainer.advance()[0])
        now = trainer.model.gaussians.means
        unmoved += int(now.shape == before.shape and torch.equal(now, before))
        before = now.clone()
    return unmoved, losses, before


@torch.no_grad()
def test_resting_leaves_out_steps_only_after_the_last_refinement(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Resting, "LEAST_GAIN", 1.0)  # no view ever gains enough: each rests every other time
    full = ScheduleConfig(coarse_until=())
    never, losses, _ = passed_steps(dataset, full)
    rested, other, _ = passed_steps(dataset, replace(full, rest_converged=True))
    assert never == 0
    assert other[:10] == losses[:10]
    assert 5 <= rested <= 10


@torch.no_grad()
def test_every_eighth_step_draws_the_whole_image(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    original = Trainer._gradients
    monkeypatch.setattr("gsopt.training.content_window.MARGIN", 0)
    monkeypatch.setattr("gsopt.training.content_window.TILE", 1)

    def note(trainer: Trainer, index: int, target: Target, *args):
        seen.append(target.colors.shape[0] * target.colors.shape[1])
        return original(trainer, index, target, *args)

    monkeypatch.setattr(Trainer, "_gradients", note)
    passed_steps(dataset, ScheduleConfig(coarse_until=(), crop_masked=True))
    assert [i + 1 for i, size in enumerate(seen) if size == SIZE * SIZE] == [8, 16, 24]


def test_the_ratio_is_that_of_squared_correlations_to_chance_over_gaussians_seen_twice() -> None:
    """By the formula of `Bands`, one Gaussian at a time: seen in two, three, one and no views."""
    gaussians, cameras = cloud(4, seed=2), ring(3, 1.0).to(torch.float32)
    views = {0: (0, 2), 1: (0, 1, 2), 2: (1,), 3: ()}
    generator, nothing = torch.Generator().manual_seed(7), torch.zeros(4, 1, 3)
    for degree in (0, 1):
        bands, colors = Bands(every=3, highest=3), torch.randn(3, 4, 3, generator=generator)
        bands.degree = degree
        for i in range(3):
            seen = torch.tensor([i in views[row] for row in range(4)])
            v = sh.C0 * torch.where(seen[:, None], colors[i], 0.0)[:, None]
            bands.note(gaussians, cameras[i], Gradients(nothing, nothing, nothing, nothing, v, nothing, nothing, None))
        found = expected = 0.0
        for row in (0, 1):
            own = list(views[row])
            directions = torch.nn.functional.normalize(gaussians.means[row] - cameras.centers[own], dim=1)
            Y = sh.basis(directions, degree + 1)[:, (1, 4)[degree] :]
            Y, g = Y - Y.mean(0), colors[own, row]
            found += float((Y.T @ g).square().sum())
            expected += float(Y.square().sum() * g.var(0).sum())
        assert bands.ratio() == pytest.approx(found / expected, rel=1e-3)
        assert bands.tensors()["n"].tolist() == [2, 3, 1, 0]


def test_the_target_cache_holds_the_megabytes_that_the_plan_grants(dataset: Path) -> None:
    config = tiny_config(dataset)
    scene = load_scene(config.data)
    gaussians, _ = first_gaussians(scene, config.init, 3, 0)
    plan = replace(RunPlan.of(config, scene), target_cache_mb=1.5)
    assert Trainer(plan, scene, gaussians, make_backend("cpu", 1))._targets._budget == 1_500_000
