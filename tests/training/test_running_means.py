"""Means that a run shows as it goes: between the values, and slower than they are."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_scenes import ring

from gsopt.training.running_means import RunningMeans
from gsopt.training.targets import Target

BLACK = Target(ring(1, 0.5), torch.zeros(2, 2, 3), None, (2, 2))


@given(st.lists(st.floats(0, 1), min_size=1, max_size=40))
def test_a_mean_lies_between_the_values_and_follows_them_slowly(losses: list[float]) -> None:
    means, shown = RunningMeans(), losses[0]
    for loss in losses:
        means.update(2, loss, BLACK.colors, BLACK)
        assert means.loss is not None
        assert min(losses) - 1e-12 <= means.loss <= max(losses) + 1e-12
        assert abs(means.loss - shown) <= 0.5 * abs(loss - shown) + 1e-12
        shown = means.loss


def test_a_mean_arrives_where_the_values_stay() -> None:
    means = RunningMeans(loss=1.0)
    for _ in range(400):
        means.update(2, 0.25, BLACK.colors, BLACK)
    assert means.loss == pytest.approx(0.25, abs=1e-6)


def test_a_value_moves_the_mean_a_twentieth_of_the_way() -> None:
    means = RunningMeans()
    for loss in (1.0, 0.0, 0.95):
        means.update(2, loss, BLACK.colors, BLACK)
    assert means.loss == pytest.approx(0.95)


def test_the_error_is_measured_at_the_first_step_and_every_tenth() -> None:
    means = RunningMeans()
    assert means.psnr is None
    measured = []
    for step in range(1, 22):
        before = means.mse
        means.update(step, 0.0, torch.full((2, 2, 3), 0.1 * step), BLACK)
        measured += [step] if means.mse != before else []
    assert measured == [1, 11, 21]


@pytest.mark.parametrize(("level", "psnr"), [(0.1, 20.0), (1.0, 0.0), (0.0, 100.0)])
def test_the_error_is_shown_in_decibels(level: float, psnr: float) -> None:
    means = RunningMeans()
    means.update(1, 0.0, torch.full((2, 2, 3), level), BLACK)
    assert means.psnr == pytest.approx(psnr, abs=1e-4)
