"""One guided step on real splats: its gradient, what the prior is told, and what happens when the prior fails."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_priors import PixelPrior, gaussian_posterior, knows

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.background import Background
from gsopt.data.scene import Scene
from gsopt.errors import InputError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.api import make_backend
from gsopt.raster.backend import RasterSettings
from gsopt.sds import policies
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.guidance_plan import GuidancePlans
from gsopt.sds.guidance_step import MAX_FAILURES, Guidance, GuidanceSetup
from gsopt.sds.observed_render import ObservedRender
from gsopt.sds.prompts import Prompt

BACKEND = make_backend("cpu", 1)
SETTINGS = RasterSettings(sh_degree=0)
ALWAYS = GuidanceConfig(
    policy="sds",
    start=0.0,
    stop=1.0,
    every=1,
    min_uncertainty=0.0,
    certain_weight=0.0,
    guidance_scale=1.0,
    clip_rms=0.0,
)
SIZE = 16
NO_WORDS = Conditioning("", (), ("",), None, None, None)


class FakeView:
    """An input view without a file."""

    def __init__(self, camera: Cameras, value: int) -> None:
        self.camera, self.name = camera, f"r_{value}"
        self._pixels = torch.full((camera.height, camera.width, 4), value, dtype=torch.uint8)

    def pixels(self) -> torch.Tensor:
        return self._pixels


def scene(*azimuths: float) -> Scene:
    views = []
    for number, azimuth in enumerate(azimuths):
        a = math.radians(azimuth)
        eye = torch.tensor([[4 * math.cos(a), 4 * math.sin(a), 1.0]], dtype=torch.float64)
        viewmat = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double())
        camera = Cameras(viewmat.float(), intrinsics(0.8, 24, 24)[None].float(), 24, 24)
        views.append(FakeView(camera, 20 * number))
    return Scene(Path(), "test", tuple(views), (), None, True, ())  # type: ignore[arg-type]


def blobs(count: int = 30, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=0.4 * torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 3), math.log(0.15)),
        logit_opacities=torch.full((count,), 1.0),
        sh0=0.5 * torch.randn(count, 1, 3, generator=generator),
        shN=torch.zeros(count, 0, 3),
    )


def guide(prior: PixelPrior, config: GuidanceConfig = ALWAYS, words: Conditioning = NO_WORDS, **changes) -> Guidance:
    settings = {"weight": 0.2, "iterations": 100, "seed": 0, "background": Background(), "warn": [].append, **changes}
    inputs = settings.pop("scene", scene(0, 40, 80))
    setup = GuidanceSetup(prior, words, inputs.train[0].camera, settings["weight"], settings["warn"])
    plans = GuidancePlans.of(config, settings["iterations"], settings["seed"], settings["background"])
    return setup.on(inputs, BACKEND, plans)


def toy(**changes) -> PixelPrior:
    return PixelPrior(gaussian_posterior(0.2, 0.5), size=SIZE, **changes)


def test_the_step_is_the_gradient_of_the_stated_loss() -> None:
    """All the way to the colors: lambda · dL/d(color) by central differences of the loss with g held fixed."""
    guided, gaussians = guide(toy(), replace(ALWAYS, certain_weight=0.25)), blobs()
    found = guided.gradients(7, gaussians, SETTINGS)
    assert found is not None
    sample = guided.last
    assert sample is not None
    camera = guided.observer.cameras.camera(sample.view, guided._random(7, sample.view, "jitter"))

    def z_of(sh0: torch.Tensor) -> torch.Tensor:
        colors = BACKEND.forward(replace(gaussians, sh0=sh0), camera, SETTINGS, torch.ones(3)).colors
        return (2 * colors.permute(2, 0, 1)[None] - 1).double()

    z, alphas = z_of(gaussians.sh0), BACKEND.forward(gaussians, camera, SETTINGS, torch.ones(3)).alphas
    seen = ObservedRender(camera, (z.float() + 1) / 2, alphas, sample.uncertainty)
    _, noise = guided._noise_sample(7, sample.view, seen, z.float())
    weights = (0.25 * alphas + 0.75 * sample.uncertainty).double()
    g = policies.sds(guided.prior, z.float(), noise).g.double()
    direction, h = torch.randn(30, 1, 3, generator=torch.Generator().manual_seed(1)), 1e-3
    ahead, behind = (
        0.2 * float(0.5 * (weights * (z_of(gaussians.sh0 + s * h * direction) - (z - g)).square()).mean())
        for s in (1, -1)
    )
    assert float((found.sh0 * direction).sum()) == pytest.approx((ahead - behind) / (2 * h), rel=1e-3)


def test_noise_levels_fill_the_range_of_the_step() -> None:
    guided, gaussians = guide(toy(), replace(ALWAYS, t_min=0.3, t_max=0.5, t_max_end=0.5)), blobs()
    camera = guided.observer.cameras.camera(0, guided._random(1, 0, "jitter"))
    frame = BACKEND.forward(gaussians, camera, SETTINGS, torch.ones(3))
    images = frame.colors.permute(2, 0, 1)[None]
    seen = ObservedRender(camera, images, frame.alphas, torch.ones_like(frame.alphas))
    levels = [guided._noise_sample(step, 0, seen, 2 * images - 1)[1].t for step in range(1, 101)]
    least, most = (guided.prior.schedule.step(share) for share in (0.3, 0.5))
    assert least <= min(levels) < least + 0.1 * (most - least)
    assert most - 0.1 * (most - least) < max(levels) <= most


@pytest.mark.parametrize("policy", ["sds", "sdi", "recon"])
def test_steps_towards_a_prior_that_knows_the_answer_reach_it(policy) -> None:
    """Descent on the colors of what is uncertain brings the render to the prior's image, whatever the policy."""
    target = torch.tensor([0.6, -0.2, 0.1]).view(3, 1, 1).expand(3, SIZE, SIZE)
    config = replace(ALWAYS, policy=policy, weighting="x0", refresh_every=1, inversion_steps=2, denoise_steps=2)
    background = Background(tuple(((target[:, 0, 0] + 1) / 2).tolist()))
    guided = guide(PixelPrior(knows(target), size=SIZE), config, background=background, iterations=120)
    gaussians, rate = blobs(), 1000 if policy == "recon" else 3000  # recon's loss is a mean over the subject alone
    distances = []
    for step in range(1, 121):
        found = guided.gradients(step, gaussians, SETTINGS)
        assert found is not None
        assert guided.last is not None
        distances.append(float((2 * guided.last.render - 1 - target).abs().mean()))
        gaussians = replace(gaussians, sh0=gaussians.sh0 - rate * found.sh0)
    assert sum(distances[-5:]) < 0.25 * sum(distances[:5])


def test_targets_of_another_version_are_refused() -> None:
    guided = guide(toy(), replace(ALWAYS, policy="recon"))
    guided.gradients(7, blobs(), SETTINGS)
    tensors, meta = guided.state()
    guided.restore(tensors, meta)
    old = {name: value[1] if name.startswith("target.") else value for name, value in tensors.items()}
    with pytest.raises(InputError, match="another version"):
        guided.restore(old, meta)


def test_empty_surroundings_do_not_weaken_a_target() -> None:
    """The same subject in a picture twice as wide is pulled alike: what is certain a quarter as hard as told, what is
    beside the subject not at all."""
    guided = guide(toy(), replace(ALWAYS, policy="recon", certain_weight=0.25))
    alphas = torch.zeros(SIZE, SIZE)
    alphas[4:12, 4:12] = 1.0
    u = 0.5 * alphas
    u[:8] = 0
    pulls = []
    for border in (0, 8):
        known, free = (torch.nn.functional.pad(plane, [border] * 4) for plane in (alphas, u))
        side = SIZE + 2 * border
        asked, target = torch.full((3, side, side), 255), torch.zeros(3, side, side)
        guided.memory.targets[0], guided.memory.target_steps[0] = torch.stack([asked, target]).to(torch.uint8), 1
        seen = ObservedRender(guided.observer.cameras.camera(0), torch.ones(1, 3, side, side), known, free)
        pulls.append(guided.image_gradient(1, 0, seen)[0, 0, border : side - border, border : side - border])
    torch.testing.assert_close(pulls[1], pulls[0])
    each = 1 / (3 * 8 * 8)  # dL/dx of a channel of one of the subject's pixels, where nothing is known
    assert float(pulls[0][5, 5]) == pytest.approx(0.25 * each, rel=5e-3)
    assert float(pulls[0][9, 9]) == pytest.approx((0.25 + 0.75 * 0.5) * each, rel=5e-3)
    assert float(pulls[0][0, 0]) == 0


@pytest.mark.parametrize("policy", ["sds", "sdi", "recon"])
def test_lambda_scales_the_gradient_and_nothing_else(policy) -> None:
    config = replace(ALWAYS, policy=policy)
    one, two = (guide(toy(), config, weight=w).gradients(3, blobs(), SETTINGS) for w in (0.2, 0.4))
    assert one is not None
    assert two is not None
    for name in PARAMETERS:
        torch.testing.assert_close(2 * getattr(one, name), getattr(two, name), rtol=1e-5, atol=1e-12)


def test_a_kept_target_stands_on_the_background_of_the_render_it_is_compared_with() -> None:
    """With random backgrounds too: of an unchanged scene, a candidate's render is the same in every step."""
    guided = guide(toy(), replace(ALWAYS, policy="recon", refresh_every=1000), background=Background(random=True))
    renders: dict[int, torch.Tensor] = {}
    met = 0
    for step in range(1, 200):
        guided.gradients(step, blobs(), SETTINGS)
        assert guided.last is not None
        met += guided.last.view in renders
        assert torch.equal(renders.setdefault(guided.last.view, guided.last.render), guided.last.render)
    assert met > 10
    assert len({float(render[0, 0, 0]) for render in renders.values()}) > 10


def test_no_weight_calls_no_prior() -> None:
    prior = toy()
    assert guide(prior, weight=0.0).gradients(3, blobs(), SETTINGS) is None
    assert prior.calls == []


def test_the_same_seed_gives_the_same_bits_and_another_does_not() -> None:
    found = [guide(toy(), seed=seed).gradients(3, blobs(), SETTINGS) for seed in (0, 0, 1)]
    assert all(gradients is not None for gradients in found)
    assert torch.equal(found[0].sh0, found[1].sh0)  # type: ignore[union-attr]
    assert not torch.equal(found[0].sh0, found[2].sh0)  # type: ignore[union-attr]


def test_geometry_can_be_left_alone() -> None:
    found = guide(toy(), replace(ALWAYS, geometry=0.0)).gradients(3, blobs(), SETTINGS)
    assert found is not None
    assert float(found.sh0.abs().max()) > 0
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert float(getattr(found, name).abs().max()) == 0


def test_what_all_inputs_see_is_left_alone() -> None:
    prior = toy()
    around = scene(*range(0, 360, 30))
    guided = guide(prior, replace(ALWAYS, min_uncertainty=0.6), scene=around)
    assert [guided.gradients(step, blobs(), SETTINGS) for step in range(1, 6)] == [None] * 5
    assert (guided.memory.counts.decided, guided.memory.counts.guided, prior.calls) == (5, 0, [])


def test_uncertain_views_are_drawn_more_often() -> None:
    """Two sheets; the input sees one of them: guidance looks at the other more often than not."""
    n = 200
    flat = torch.randn(n, 3, generator=torch.Generator().manual_seed(3)) * torch.tensor([0.0, 0.4, 0.4])
    sheets = torch.cat([flat + torch.tensor([0.4, 0, 0]), flat - torch.tensor([0.4, 0, 0])])
    gaussians = replace(
        blobs(2 * n),
        means=sheets,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(2 * n, 1),
        log_scales=torch.tensor([[0.02, 0.15, 0.15]]).log().repeat(2 * n, 1),
        logit_opacities=torch.full((2 * n,), 4.0),
    )
    guided = guide(toy(), scene=scene(-5, 0, 5))
    behind = 0
    for step in range(1, 61):
        assert guided.gradients(step, gaussians, SETTINGS) is not None
        assert guided.last is not None
        behind += bool(guided.observer.cameras.candidates.centers[guided.last.view, 0] < 0)
    assert behind > 30  # more than half


def test_the_prior_is_told_everything_about_the_view() -> None:
    """A view-conditioned prior gets the aligned render with alpha, its camera, the nearest references, words."""
    prior = toy(words=None)
    tokens = torch.arange(6.0).view(3, 2, 1).expand(3, 2, 4)
    words = Conditioning("fake", (Prompt("a chair"),), ("", "a chair", "a chair, overhead view"), tokens, None, None)
    config = replace(ALWAYS, guidance_scale=2.0, references=2)
    guided = guide(prior, config, words)
    guided.gradients(4, blobs(), SETTINGS)
    positive, negative = prior.seen
    sample = guided.last
    assert sample is not None
    assert positive.render is not None
    assert positive.render.shape == (4, SIZE, SIZE)
    torch.testing.assert_close(positive.render[:3], sample.render.clamp(0, 1))
    camera = guided.observer.cameras.camera(sample.view, guided._random(4, sample.view, "jitter"))
    assert positive.camera is not None
    assert torch.equal(positive.camera.viewmats, camera.viewmats)
    assert positive.references is not None
    assert positive.references.images.shape == (2, 3, SIZE, SIZE)
    assert (positive.references.cameras.width, len(positive.references.cameras)) == (SIZE, 2)
    assert positive.tokens is not None
    assert torch.equal(positive.tokens, words.tokens[words.texts.index(sample.text)])  # type: ignore[index]
    assert sample.text.startswith("a chair")
    assert negative.tokens is not None
    assert torch.equal(negative.tokens, tokens[0])
    assert (negative.references, negative.class_embedding) == (None, None)
    assert negative.render is positive.render
    assert negative.camera is positive.camera


def test_a_view_conditioned_prior_can_use_its_references() -> None:
    """A prior that answers its nearest reference pulls the render to that input view's color."""

    def answer(x_t, signal, condition):
        return 2 * condition.references.images[0] - 1

    guided = guide(PixelPrior(answer, size=SIZE), replace(ALWAYS, weighting="x0"))
    assert guided.gradients(4, blobs(), SETTINGS) is not None
    assert guided.last is not None
    camera = guided.observer.cameras.camera(guided.last.view, guided._random(4, guided.last.view, "jitter"))
    closest = int((guided.observer.references.cameras.forwards @ camera.forwards[0]).argmax())
    assert len({float(image.mean()) for image in guided.observer.references.images}) == 3
    torch.testing.assert_close(guided.last.estimate[0], 2 * guided.observer.references.images[closest] - 1)


def test_a_cached_target_is_used_until_it_is_too_old_and_survives_a_checkpoint() -> None:
    prior = toy()
    config = replace(ALWAYS, policy="recon", refresh_every=10, denoise_steps=3)
    guided = guide(prior, config)
    known = guided.observer.coverage(1, blobs())
    always_the_same = torch.nn.functional.one_hot(torch.tensor(5), 36).float()
    guided.memory.coverage = replace(known, mean_u=always_the_same)
    calls = []
    for step in (1, 2, 10, 11, 12):
        before = len(prior.calls)
        assert guided.gradients(step, blobs(), SETTINGS) is not None
        calls.append(len(prior.calls) - before)
    assert calls == [3, 0, 0, 3, 0]
    other = guide(toy(), config)
    other.restore(*guided.state())
    one, two = (g.gradients(13, blobs(), SETTINGS) for g in (guided, other))
    assert one is not None
    assert two is not None
    assert torch.equal(one.sh0, two.sh0)
    assert other.prior.calls == []  # type: ignore[attr-defined]


@pytest.mark.parametrize("policy", ["sds", "sdi", "recon"])
def test_a_prior_that_fails_costs_the_step_then_the_guidance_never_the_run(policy) -> None:
    told: list[str] = []
    prior = PixelPrior(lambda x_t, a, c: torch.full_like(x_t, math.nan), size=SIZE, name="broken")
    guided = guide(prior, replace(ALWAYS, policy=policy), warn=told.append)
    assert [guided.gradients(step, blobs(), SETTINGS) for step in range(1, 9)] == [None] * 8
    assert (guided.memory.counts.failed, guided.memory.counts.ended) == (MAX_FAILURES, True)
    assert len(told) == MAX_FAILURES
    assert "broken" in told[0]
    assert "without guidance" in told[-1]


def test_one_failure_is_forgiven() -> None:
    prior = toy()
    answer = prior.answer
    prior.answer = lambda x_t, a, c: torch.full_like(x_t, math.nan) if len(prior.calls) == 2 else answer(x_t, a, c)
    guided = guide(prior)
    found = [guided.gradients(step, blobs(), SETTINGS) is not None for step in range(1, 6)]
    assert found == [True, False, True, True, True]
    assert (guided.memory.counts.guided, guided.memory.counts.failed, guided.memory.counts.failed_in_a_row) == (4, 1, 0)


def test_too_little_memory_is_a_failure_of_the_step() -> None:
    prior = toy()

    def full(x_t, a, c):
        raise torch.OutOfMemoryError("no memory left")

    prior.answer = full
    told: list[str] = []
    guided = guide(prior, warn=told.append)
    assert guided.gradients(1, blobs(), SETTINGS) is None
    assert "no memory left" in told[0]


def test_state_and_restore_continue_with_the_same_bits() -> None:
    guided, gaussians = guide(toy()), blobs()
    for step in range(1, 6):
        guided.gradients(step, gaussians, SETTINGS)
    other = guide(toy())
    other.restore(*guided.state())
    moved = replace(gaussians, means=gaussians.means + 0.3)  # coverage is remembered, not taken anew
    one, two = (g.gradients(6, moved, SETTINGS) for g in (guided, other))
    assert one is not None
    assert two is not None
    for name in PARAMETERS:
        assert torch.equal(getattr(one, name), getattr(two, name))
    assert other.memory.counts == guided.memory.counts


def test_the_set_of_gaussians_may_change_between_steps() -> None:
    guided = guide(toy())
    assert guided.gradients(1, blobs(30), SETTINGS) is not None
    guided.forget()
    assert guided.gradients(2, blobs(40), SETTINGS) is not None
    assert guided.memory.coverage is not None
    assert len(guided.memory.coverage.covered) == 40
