"""Laws of learned exposure: gradients are autograd's, the mean stays neutral, brightened photos are recognized."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_scenes import cloud, tiny_config

from gsopt.config.train import ExposureConfig, SparseConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.raster.backend import RasterSettings, RenderedFrame
from gsopt.raster.reference import ReferenceBackend
from gsopt.training.exposure import BETA1, Exposure
from gsopt.training.loop import train

WHITE = torch.ones(3)


def started(scene: Scene, steps: int) -> Exposure:
    """Gains that change from the first step on."""
    return Exposure(ExposureConfig(learn=True, start=0, lr=2e-2, lr_final=1e-3), scene, steps)


def frame_of(colors: torch.Tensor, alphas: torch.Tensor) -> RenderedFrame:
    return RenderedFrame(colors, alphas, None, torch.zeros(0, 2, dtype=torch.int32), None)


def test_gradients_are_those_of_autograd(dataset: Path) -> None:
    """In the colors, the alphas and the log gains, with a background and without."""
    generator = torch.Generator().manual_seed(4)
    colors, v_exposed = (torch.rand(5, 6, 3, generator=generator).double() for _ in range(2))
    alphas = torch.rand(5, 6, generator=generator).double()
    for background in (None, torch.tensor([0.2, 0.9, 0.5]).double()):
        exposure = started(load_scene(dataset), 10)
        exposure.log_gains[1] = torch.tensor([0.2, -0.1, 0.3])
        gains = exposure.log_gains[1].clone().requires_grad_()
        free_colors, free_alphas = colors.clone().requires_grad_(), alphas.clone().requires_grad_()
        left = 0 if background is None else (1 - free_alphas)[..., None] * background
        exposed = gains.exp() * (free_colors - left) + left
        frame = frame_of(colors, alphas)
        torch.testing.assert_close(exposure.exposed(1, frame, background), exposed.detach())
        (exposed * v_exposed).sum().backward()
        assert gains.grad is not None
        v_colors, v_alphas = exposure.backward(1, 1, frame, background, v_exposed)
        torch.testing.assert_close(v_colors, free_colors.grad)
        torch.testing.assert_close(exposure.tensors()["exp_avg"][1], (1 - BETA1) * gains.grad)
        assert (v_alphas is None) == (background is None)
        if v_alphas is not None:
            torch.testing.assert_close(v_alphas, free_alphas.grad)


def test_brightened_photos_are_recognized_and_the_mean_stays_neutral(dataset: Path) -> None:
    """The Gaussians are the truth and stay; only the gains are learned."""
    scene, backend, truth = load_scene(dataset), ReferenceBackend(), cloud(40, seed=7)
    steps = 150 * len(scene.train)
    exposure = started(scene, steps)
    wanted = 0.3 * torch.randn(len(scene.train), 3, generator=torch.Generator().manual_seed(2)).double()
    wanted -= wanted.mean(0)
    frames = [backend.forward(truth, view.camera, RasterSettings(sh_degree=1), WHITE) for view in scene.train]
    known = Exposure(ExposureConfig(), scene, steps)
    known.log_gains.copy_(wanted)
    targets = [known.exposed(row, frame, WHITE) for row, frame in enumerate(frames)]
    for step in range(1, steps + 1):
        row = step % len(frames)
        difference = exposure.exposed(row, frames[row], WHITE) - targets[row]
        exposure.backward(row, step, frames[row], WHITE, 2 * difference)
        assert float(exposure.log_gains.mean(0).abs().max()) < 1e-15
    torch.testing.assert_close(exposure.log_gains, wanted, atol=5e-3, rtol=0)


def test_mirror_images_share_the_gains_of_their_photo_and_guessed_views_have_none(dataset: Path) -> None:
    scene = load_scene(dataset)
    mirrored = tuple(replace(view, mirrored=True) for view in scene.train[:2])
    guessed = (replace(scene.train[0], store=load_scene(dataset).train[0].store),)
    exposure = Exposure(ExposureConfig(), replace(scene, mirrored=mirrored, guessed=guessed), 10)
    count = len(scene.train)
    assert [exposure.row(index) for index in range(count + 3)] == [*range(count), 0, 1, None]


def test_photos_are_taken_as_they_are_until_start_and_without_the_flag(dataset: Path, tmp_path: Path) -> None:
    base = replace(tiny_config(dataset), sparse=SparseConfig(below_views=0))
    train(base, tmp_path / "off")
    train(replace(base, exposure=ExposureConfig(learn=True, start=base.iterations)), tmp_path / "late")
    assert not (tmp_path / "off/exposure.json").exists()
    views = json.loads((tmp_path / "late/exposure.json").read_text())["views"]
    assert [view["name"] for view in views] == [view.name for view in load_scene(dataset).train]
    assert all(view["gains"] == [1.0, 1.0, 1.0] for view in views)
    train(replace(base, exposure=ExposureConfig(learn=True, start=0)), tmp_path / "on")
    assert (tmp_path / "off/splat.ply").read_bytes() != (tmp_path / "on/splat.ply").read_bytes()


def test_gains_take_adams_steps_at_a_rate_that_falls_by_the_same_factor(dataset: Path) -> None:
    scene = load_scene(dataset)
    config = ExposureConfig(learn=True, start=10, lr=1e-2, lr_final=1e-4)
    found = Exposure(config, scene, 110)
    assert [found.rate(step) for step in (10, 60, 110)] == pytest.approx([1e-2, 1e-3, 1e-4])
    assert Exposure(config, scene, 10).rate(10) == pytest.approx(1e-2)
    own = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([own], lr=1.0, betas=(0.9, 0.99), eps=1e-15)
    expected = torch.zeros(len(scene.train), 3, dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    for step in (9, 10, 11, 12, 50):
        gradient = torch.randn(3, dtype=torch.float64, generator=random)
        before = own.detach().clone()
        found._update(1, step, gradient)
        if step > 10:
            own.grad = gradient
            adam.step()
            expected[1] += found.rate(step) * (own.detach() - before)
            expected -= expected.mean(0)
        torch.testing.assert_close(found.log_gains, expected)
    record = found.record()
    assert record["version"] == 1
    assert [view["name"] for view in record["views"]] == [view.name for view in scene.train]
    assert record["views"][1]["gains"] == pytest.approx(expected[1].exp().tolist())
    again = Exposure(config, scene, 110)
    again.restore(found.tensors())
    assert all(torch.equal(a, b) for a, b in zip(again.tensors().values(), found.tensors().values(), strict=True))
