"""The mathematics of guidance: gradients, fixed points, and priors whose score is known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from analytic_priors import NOBODY, PixelPrior, cosine_schedule, gaussian_posterior, knows, scale

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.background import Background
from gsopt.errors import InputError, NumericalError
from gsopt.sds import policies
from gsopt.sds.guidance_plan import GuidancePlan
from gsopt.sds.noise import PREDICTIONS, NoiseSchedule, add_noise, eps_from, generator, output_for, weight, x0_from
from gsopt.sds.policies import NoiseSample
from gsopt.sds.priors.protocol import Condition, Pair, guided_x0

WEIGHTINGS = ("sigma2", "fantasia", "one", "x0")


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def look(t: int = 400, seed: int = 5, **changes: object) -> NoiseSample:
    settings: dict[str, object] = {"pair": NOBODY, "scale": scale(), **changes}
    return NoiseSample(t=t, eps=normal(1, 3, 8, 8, seed=seed), **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", WEIGHTINGS)
@pytest.mark.parametrize("t", [20, 400, 900])
def test_the_gradient_is_lambda_times_g(kind: str, t: int) -> None:
    prior = PixelPrior(gaussian_posterior(0.3, 0.5))
    z, weights, strength = normal(1, 3, 8, 8, seed=1).requires_grad_(), normal(1, 1, 8, 8, seed=2).abs(), 0.2
    seen = look(t, weighting=kind)
    pull = policies.sds(prior, z, seen)
    (strength * policies.loss(z, pull.g, weights)).backward()
    signal = prior.schedule.signal(torch.tensor([t]), z)
    x_t = add_noise(z.detach(), seen.eps, signal)
    eps_hat = eps_from(prior.denoise(x_t, torch.tensor([t]), [Condition()]), x_t, signal)
    expected = strength * weights * weight(kind, signal) * (eps_hat - seen.eps)
    assert z.grad is not None
    torch.testing.assert_close(z.grad * z.numel(), expected, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(z.grad * z.numel(), strength * weights * pull.g, rtol=1e-12, atol=1e-15)


def test_lambda_does_not_depend_on_the_resolution() -> None:
    """The same image in twice as many pixels moves its content by the same amount."""
    prior = PixelPrior(knows(torch.zeros(1, 1, 1, dtype=torch.float64)))
    z = normal(1, 3, 4, 4)
    moved = []
    for image in (z, z.repeat_interleave(2, 2).repeat_interleave(2, 3)):
        leaf = image.clone().requires_grad_()
        pull = policies.sds(prior, leaf, NoiseSample(400, torch.zeros_like(image), NOBODY, scale()))
        policies.loss(leaf, pull.g, torch.ones(1, 1, *image.shape[2:])).backward()
        assert leaf.grad is not None
        moved.append(torch.nn.functional.adaptive_avg_pool2d(leaf.grad, 4) * leaf.grad[0, 0].numel() / 16)
    torch.testing.assert_close(moved[0], moved[1])


@pytest.mark.parametrize("kind", WEIGHTINGS)
def test_a_perfect_denoiser_pulls_nowhere(kind: str) -> None:
    z = normal(1, 3, 8, 8)
    prior = PixelPrior(knows(z[0]))
    assert policies.sds(prior, z, look(weighting=kind)).g.abs().max() == 0
    assert policies.sdi(prior, z, look(weighting=kind), steps=4).g.abs().max() == 0
    torch.testing.assert_close(policies.denoised(prior, z, look(), steps=3), z)


def test_the_weighting_x0_is_the_plain_difference_to_the_estimate() -> None:
    prior = PixelPrior(gaussian_posterior(0.3, 0.5))
    z = normal(1, 3, 8, 8)
    pull = policies.sds(prior, z, look(weighting="x0"))
    torch.testing.assert_close(pull.g, z - pull.x0)


def test_an_analytic_gaussian_prior_pulls_to_its_mean() -> None:
    """E[g] over the noise is w sqrt(a (1-a)) / (a s² + 1 - a) · (z - mean): the gradient of -log p_t, times w sigma."""
    mean, std, t = 0.3, 0.5, 400
    prior = PixelPrior(gaussian_posterior(mean, std), schedule=cosine_schedule())
    z = normal(1, 3, 8, 8)
    signal = prior.schedule.signal(torch.tensor([t]), z)
    draws = [policies.sds(prior, z, look(t, seed=seed, weighting="one")).g for seed in range(200)]
    antithetic = [
        policies.sds(prior, z, NoiseSample(t, -look(t, seed=seed).eps, NOBODY, scale(), "one")).g for seed in range(200)
    ]
    found = (sum(draws) + sum(antithetic)) / 400
    expected = (signal * (1 - signal)).sqrt() / (signal * std**2 + 1 - signal) * (z - mean)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_gradient_descent_on_an_analytic_gaussian_prior_ends_at_its_mean() -> None:
    prior = PixelPrior(gaussian_posterior(0.3, 0.5))
    z = normal(1, 3, 8, 8)
    for step in range(400):
        random = generator(0, step, 0, "noise")
        eps = torch.randn(z.shape, generator=random, dtype=z.dtype)
        t = int(torch.randint(20, 700, (1,), generator=random))
        z = z - 0.1 * (
            policies.sds(prior, z, NoiseSample(t, eps, NOBODY, scale())).g
            + policies.sds(prior, z, NoiseSample(t, -eps, NOBODY, scale())).g
        )
    torch.testing.assert_close(z, torch.full_like(z, 0.3), rtol=0, atol=1e-3)


def test_inversion_follows_the_probability_flow_of_a_gaussian() -> None:
    """x_t = sqrt(a) m + sqrt(a s² + 1 - a) (z - m) / s solves the flow for N(m, s²) exactly."""
    mean, std, t = 0.3, 0.5, 600
    prior = PixelPrior(gaussian_posterior(mean, std))
    z = normal(1, 3, 4, 4)
    signal = prior.schedule.signal(torch.tensor([t]), z)
    exact = signal.sqrt() * mean + (signal * std**2 + 1 - signal).sqrt() * (z - mean) / std
    errors = [float((policies.inverted(prior, z, look(t), n) - exact).abs().max()) for n in (5, 50, 600)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02


def test_inverted_noise_does_not_depend_on_the_seed() -> None:
    prior, z = PixelPrior(gaussian_posterior(0.3, 0.5)), normal(1, 3, 8, 8)
    assert torch.equal(policies.sdi(prior, z, look(seed=1), 4).g, policies.sdi(prior, z, look(seed=2), 4).g)
    assert not torch.equal(policies.sds(prior, z, look(seed=1)).g, policies.sds(prior, z, look(seed=2)).g)


def test_denoising_in_many_steps_reaches_the_posterior_of_the_flow() -> None:
    """Noise and back in many DDIM steps keeps the marginals: the mean stays, the spread about it is the prior's."""
    mean, std = 0.3, 0.5
    prior = PixelPrior(gaussian_posterior(mean, std))
    z = mean + std * normal(1, 3, 64, 64)
    target = policies.denoised(prior, z, NoiseSample(900, normal(1, 3, 64, 64, seed=9), NOBODY, scale()), 300)
    assert float(target.mean()) == pytest.approx(mean, abs=0.02)
    assert float(target.std()) == pytest.approx(std, abs=0.02)
    once = policies.denoised(prior, z, NoiseSample(900, normal(1, 3, 64, 64, seed=9), NOBODY, scale()), 1)
    assert float(once.std()) < 0.2  # one step answers the mean of all that could be


@pytest.mark.parametrize("t", [1, 5, 400, 999])
@pytest.mark.parametrize("steps", [1, 3, 50])
def test_times_fall_from_t_and_never_repeat(t: int, steps: int) -> None:
    found = policies.times(t, steps)
    assert found[0] == t
    assert found == sorted(set(found), reverse=True)
    assert len(found) == min(t, steps)
    assert found[-1] >= 1


@pytest.mark.parametrize("t", [20, 500, 980])
def test_models_that_predict_eps_v_and_x0_agree(t: int) -> None:
    z = normal(1, 3, 8, 8).float()
    found = {}
    for kind in PREDICTIONS:
        prior = PixelPrior(gaussian_posterior(0.3, 0.5), prediction=kind)
        seen = NoiseSample(t, normal(1, 3, 8, 8, seed=3).float(), NOBODY, scale())
        found[kind] = policies.sds(prior, z, seen).g
    torch.testing.assert_close(found["epsilon"], found["sample"], rtol=0, atol=1e-4)
    torch.testing.assert_close(found["v_prediction"], found["sample"], rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", PREDICTIONS)
def test_an_output_says_x0_and_back(kind) -> None:
    x0, eps, signal = normal(1, 3, 4, 4), normal(1, 3, 4, 4, seed=1), torch.full((1, 1, 1, 1), 0.37).double()
    x_t = add_noise(x0, eps, signal)
    torch.testing.assert_close(x0_from(output_for(x0, eps, signal, kind), x_t, signal, kind), x0)
    torch.testing.assert_close(eps_from(x0, x_t, signal), eps)


def test_treating_v_as_eps_would_be_noticed() -> None:
    """The mistake most public SDS code makes with SD 2.1."""
    x0, eps, signal = normal(1, 3, 4, 4), normal(1, 3, 4, 4, seed=1), torch.full((1, 1, 1, 1), 0.37).double()
    v = output_for(x0, eps, signal, "v_prediction")
    assert (x0_from(v, add_noise(x0, eps, signal), signal, "epsilon") - x0).abs().max() > 0.5


def halves(positive: float, negative: float):
    """Answers by which half it is asked for."""
    return lambda x_t, signal, condition: torch.full_like(x_t, positive if condition.tokens is not None else negative)


PAIR = Pair(Condition(tokens=torch.zeros(1, 2)), Condition())


@pytest.mark.parametrize(("s", "rows"), [(1.0, [1]), (0.0, [1]), (3.0, [2])])
def test_guidance_of_one_or_none_makes_one_call_of_one_row(s: float, rows: list[int]) -> None:
    prior = PixelPrior(halves(2.0, 1.0))
    x0 = guided_x0(prior, normal(1, 3, 4, 4), 300, PAIR, scale(s))
    assert prior.calls == rows
    torch.testing.assert_close(x0, torch.full_like(x0, 1 + s))


def test_guidance_of_x0_is_guidance_of_eps() -> None:
    prior = PixelPrior(lambda x_t, a, c: 0.3 * x_t + (0.2 if c.tokens is not None else -0.1))
    x_t, t, s = normal(1, 3, 4, 4), 300, 7.5
    signal = prior.schedule.signal(torch.tensor([t]), x_t)
    eps_c, eps_u = (
        eps_from(prior.denoise(x_t, torch.tensor([t]), [c]), x_t, signal) for c in (PAIR.positive, PAIR.negative)
    )
    x0 = guided_x0(prior, x_t, t, PAIR, scale(s))
    torch.testing.assert_close(eps_from(x0, x_t, signal), eps_u + s * (eps_c - eps_u))


def test_sequential_halves_give_what_one_batch_gives() -> None:
    prior = PixelPrior(lambda x_t, a, c: 0.3 * x_t + (0.2 if c.tokens is not None else -0.1))
    x_t = normal(1, 3, 4, 4)
    batch = guided_x0(prior, x_t, 300, PAIR, scale(5.0, rescale=0.5))
    assert torch.equal(guided_x0(prior, x_t, 300, PAIR, scale(5.0, rescale=0.5, sequential=True)), batch)
    assert prior.calls == [2, 1, 1]


def test_full_rescaling_restores_the_contrast_and_keeps_the_mean() -> None:
    one, other = normal(3, 4, 4), normal(3, 4, 4, seed=1)
    prior = PixelPrior(lambda x_t, a, c: 0.8 + (one if c.tokens is not None else other))
    x_t = normal(1, 3, 4, 4)
    plain, rescaled = (guided_x0(prior, x_t, 300, PAIR, scale(7.0, rescale=r)) for r in (0.0, 1.0))
    assert float(rescaled.std()) == pytest.approx(float(one.std()), rel=1e-6)
    assert float(rescaled.mean()) == pytest.approx(float(plain.mean()), rel=1e-6)
    assert float(plain.std()) > 2 * float(one.std())


def test_a_pixel_prior_is_kept_in_range() -> None:
    prior = PixelPrior(halves(2.0, 1.0), x0_limit=1.0)
    assert float(guided_x0(prior, normal(1, 3, 4, 4), 300, PAIR, scale(9.0)).max()) == 1.0


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("s", [1.0, 3.0])
def test_what_is_not_finite_is_an_error_that_names_the_model_and_the_place(value: float, s: float) -> None:
    prior = PixelPrior(lambda x_t, a, c: torch.full_like(x_t, value), name="broken model")
    with pytest.raises(NumericalError, match=r"broken model.*index \[0, 0, 0, 0\].*t=300"):
        guided_x0(prior, normal(1, 3, 4, 4), 300, PAIR, scale(s))


def test_clipping_bounds_the_root_mean_square_and_spares_the_small() -> None:
    g = 5 * normal(1, 3, 8, 8)
    assert float(policies.clipped(g, 1.0).square().mean().sqrt()) == pytest.approx(1.0)
    assert torch.equal(policies.clipped(g, 0.0), g)
    assert torch.equal(policies.clipped(g, 100.0), g)


def test_random_numbers_depend_on_seed_step_view_and_purpose_alone() -> None:
    def drawn(*key) -> float:
        return float(torch.rand(1, generator=generator(*key)))

    assert drawn(0, 1, 2, "noise") == drawn(0, 1, 2, "noise")
    others = [(1, 1, 2, "noise"), (0, 2, 2, "noise"), (0, 1, 3, "noise"), (0, 1, 2, "camera"), (0, 12, 2, "noise")]
    assert len({drawn(0, 1, 2, "noise"), *(drawn(*key) for key in others)}) == 6


@pytest.mark.parametrize("values", [[0.9], [0.5, 0.6], [1.2, 0.5], [0.5, -0.1], [0.5, math.nan]])
def test_what_is_no_noise_schedule_is_refused(values: list[float]) -> None:
    with pytest.raises(InputError, match="alphas_cumprod"):
        NoiseSchedule.of(torch.tensor(values))


def test_the_pull_of_recon_is_the_gradient_of_its_loss() -> None:
    """Equation (2), by autograd in float64; nothing is pulled where the weight or the difference is 0."""
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(1, 3, 5, 5, dtype=torch.float64, generator=generator)
    target = torch.rand(1, 3, 5, 5, dtype=torch.float64, generator=generator)
    target[..., 0] = images[..., 0]
    weights = torch.rand(5, 5, dtype=torch.float64, generator=generator)
    weights[0] = 0
    leaf = images.clone().requires_grad_()
    (weights * ((leaf - target).square() + policies.ROUNDING**2).sqrt()).mean().backward()
    found = policies.pixel_gradient(images, target, weights)
    torch.testing.assert_close(found, leaf.grad, rtol=1e-12, atol=0)
    assert float(found[..., 0, :].abs().max()) == float(found[..., 0].abs().max()) == 0


def test_an_old_target_pulls_only_where_and_as_far_as_the_prior_wanted() -> None:
    """Per value: no change was wanted; a large one is under way; it has been passed; a slight one."""
    asked = torch.tensor([0.5, 0.5, 0.5, 0.5]).view(1, 1, 2, 2)
    target = torch.tensor([0.5, 0.9, 0.9, 0.5 + policies.CHANGE_SCALE]).view(1, 1, 2, 2)
    images = torch.tensor([0.7, 0.6, 0.95, 0.5]).view(1, 1, 2, 2)
    found = policies.wanted(images, asked, target).flatten()
    assert found[0] == found[2] == 0
    assert float(found[1]) == pytest.approx(1, abs=0.02)
    assert float(found[3]) == pytest.approx(0.5, abs=1e-5)


def test_what_is_left_open_is_resolved_by_the_kind_of_prior_and_what_is_given_stays() -> None:
    def resolved(config: GuidanceConfig, kind: bool) -> GuidancePlan:
        return GuidancePlan.of(config, 1000, 0, Background(), view_conditioned=kind)

    view, text = (resolved(GuidanceConfig(), kind) for kind in (True, False))
    assert (view.policy, view.every, view.guidance_scale, view.denoise_steps) == ("recon", 2, 1.0, 1)
    assert (text.policy, text.every, text.guidance_scale, text.denoise_steps) == ("sds", 10, 3.0, 5)
    assert (view.min_uncertainty, view.certain_weight) == (0.0, 1.0)
    assert (text.min_uncertainty, text.certain_weight) == (0.05, 0.0)
    given = GuidanceConfig(
        policy="sds", every=7, guidance_scale=5.0, denoise_steps=3, min_uncertainty=0.1, certain_weight=0.3
    )
    names = ("policy", "every", "guidance_scale", "denoise_steps", "min_uncertainty", "certain_weight")
    for kind in (True, False):
        assert [getattr(resolved(given, kind), name) for name in names] == [getattr(given, name) for name in names]


def test_inversion_asks_for_nothing_but_the_unconditional_noise() -> None:
    prior = PixelPrior(gaussian_posterior(0.3, 0.5))
    words = Pair(Condition(), Condition())
    policies.inverted(prior, normal(1, 3, 4, 4), look(pair=words, scale=scale(7.5)), 3)
    assert len(prior.seen) == 3
    assert all(condition is words.negative for condition in prior.seen)
