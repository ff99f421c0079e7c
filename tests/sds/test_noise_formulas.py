"""The forward process against its formulas: schedules, steps, predictions, limits."""

from __future__ import annotations

import math

import pytest
import torch

from gsopt.errors import InputError
from gsopt.sds.noise import NoiseSchedule, add_noise, x0_from
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.view_conditioned import (
    NOISE_STEPS,
    PATCH_SIDE,
    TOKEN_WIDTH,
    UNET_WIDTHS,
    TextTokens,
    cosine_schedule,
    side_multiple,
)


def test_the_cosine_schedule_is_that_of_nichol_and_dhariwal() -> None:
    """Equation 17 with s = 0.008: f(t) / f(0), f(t) = cos²((t/T + s) / (1 + s) · π/2)."""

    def f(share: float) -> float:
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    signal = cosine_schedule().alphas_cumprod
    assert len(signal) == NOISE_STEPS
    for step in (0, 1, NOISE_STEPS // 2, NOISE_STEPS - 2):
        assert float(signal[step]) == pytest.approx(f((step + 1) / NOISE_STEPS) / f(0), rel=1e-6)
    assert float(signal[-1]) == pytest.approx(1e-6)
    assert float(signal.max()) <= 1


def test_an_image_side_is_a_multiple_of_a_patch_halved_between_levels() -> None:
    side = side_multiple()
    for _ in UNET_WIDTHS[1:]:
        assert side % 2 == 0
        side //= 2
    assert side == PATCH_SIDE


def test_a_share_of_the_process_is_a_step() -> None:
    schedule = NoiseSchedule(torch.linspace(1, 0, 10, dtype=torch.float64))
    assert [schedule.step(share) for share in (-1.0, 0.0, 0.09, 0.1, 0.55, 0.99, 1.0, 2.0)] == [0, 0, 0, 1, 5, 9, 9, 9]
    signal = schedule.signal(torch.tensor([0, 9]), torch.zeros(1))
    assert signal.shape == (2, 1, 1, 1)
    assert signal.flatten().tolist() == [1.0, 0.0]
    assert signal.dtype == torch.float32


@pytest.mark.parametrize(
    ("values", "fine"),
    [
        ([1.0, 0.0], True),
        ([0.5, 0.5, 0.5], True),
        ([1.0], False),
        ([1.0000001, 0.5], False),
        ([0.5, 0.500001], False),
        ([0.5, -1e-9], False),
    ],
)
def test_a_schedule_falls_from_at_most_one_to_at_least_zero(values: list[float], fine: bool) -> None:
    tensor = torch.tensor(values, dtype=torch.float64)
    if fine:
        assert NoiseSchedule.of(tensor).alphas_cumprod.tolist() == values
    else:
        with pytest.raises(InputError, match=f"got {len(values)} values"):
            NoiseSchedule.of(tensor)


def test_each_kind_of_prediction_gives_back_the_image() -> None:
    random = torch.Generator().manual_seed(0)
    x0, eps = (torch.randn(3, 4, 5, 5, generator=random, dtype=torch.float64) for _ in "ab")
    signal = torch.tensor([0.9, 0.5, 0.01], dtype=torch.float64).view(3, 1, 1, 1)
    x_t = add_noise(x0, eps, signal)
    torch.testing.assert_close(x_t, signal**0.5 * x0 + (1 - signal) ** 0.5 * eps)
    v = signal**0.5 * eps - (1 - signal) ** 0.5 * x0
    for prediction, output in (("sample", x0), ("epsilon", eps), ("v_prediction", v)):
        torch.testing.assert_close(x0_from(output, x_t, signal, prediction), x0)  # type: ignore[arg-type]


def test_rows_of_tokens_are_padded_to_the_longest() -> None:
    first, second = torch.ones(3, TOKEN_WIDTH), 2 * torch.ones(5, TOKEN_WIDTH)
    found = TextTokens.from_conditions([Condition(tokens=first), Condition(), Condition(tokens=second)])
    assert found.tokens.shape == (3, 5, TOKEN_WIDTH)
    assert found.mask.tolist() == [[True] * 3 + [False] * 2, [True] + [False] * 4, [True] * 5]
    assert torch.equal(found.tokens[0, :3], first)
    assert torch.equal(found.tokens[2], second)
    assert not found.tokens[1].any()
    empty = TextTokens.empty(2)
    assert (empty.tokens.shape, empty.mask.shape) == ((2, 1, TOKEN_WIDTH), (2, 1))
    assert empty.mask.all()
    assert not empty.tokens.any()
