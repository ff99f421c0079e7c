"""Quaternions: a double cover of the rotations, whatever their norm."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings, strategies
from torch import Tensor

from gsopt.geometry import quats

drawn = settings(max_examples=50, deadline=None, derandomize=True)
seeds = strategies.integers(0, 2**31 - 1)


def assert_equal(got: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(got, expected, atol=1e-13, rtol=0)


def random(seed: int, count: int = 8) -> Tensor:
    return torch.randn(count, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_axis_and_angle() -> None:
    angle = 0.7
    turn = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=torch.float64)
    c, s = math.cos(angle), math.sin(angle)
    expected = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    assert_equal(quats.rotation_matrices(turn), expected)


@drawn
@given(seed=seeds)
def test_matrices_are_rotations(seed: int) -> None:
    R = quats.rotation_matrices(random(seed))
    assert_equal(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
    assert_equal(torch.linalg.det(R), torch.ones(8, dtype=torch.float64))


@drawn
@given(seed=seeds, norm=strategies.sampled_from([-1.0, 1e-30, 1e-12, 3.0, 1e25]))
def test_the_norm_does_not_matter(seed: int, norm: float) -> None:
    q = random(seed)
    assert_equal(quats.rotation_matrices(norm * q), quats.rotation_matrices(q))
    single = quats.rotation_matrices((norm * q).float())
    torch.testing.assert_close(single, quats.rotation_matrices(q).float(), atol=1e-6, rtol=0)


@drawn
@given(seed=seeds)
def test_the_product_composes_and_the_conjugate_inverts(seed: int) -> None:
    p, q = random(seed), random(seed + 1)
    product = quats.rotation_matrices(p) @ quats.rotation_matrices(q)
    assert_equal(quats.rotation_matrices(quats.multiply(p, q)), product)
    one = quats.normalize(quats.multiply(p, quats.conjugate(p)))
    assert_equal(one, torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(8, 4))


@drawn
@given(seed=seeds)
def test_from_matrices_goes_back(seed: int) -> None:
    q = quats.normalize(random(seed))
    q = torch.where(q[:, :1] < 0, -q, q)
    assert_equal(quats.from_rotation_matrices(quats.rotation_matrices(q)), q)


@pytest.mark.parametrize("axis", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.6, -0.8, 0]])
def test_from_matrices_holds_for_half_turns(axis: list[float]) -> None:
    half_turn = torch.tensor([0.0, *axis], dtype=torch.float64)
    R = quats.rotation_matrices(half_turn)
    assert_equal(quats.rotation_matrices(quats.from_rotation_matrices(R)), R)


def test_the_gradient_has_no_part_along_the_quaternion() -> None:
    q = random(3).requires_grad_()
    weights = torch.randn(8, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    (quats.rotation_matrices(q) * weights).sum().backward()
    assert q.grad is not None
    assert float(q.grad.abs().max()) > 0.1
    assert_equal((q.grad * q.detach()).sum(dim=1), torch.zeros(8, dtype=torch.float64))
    assert torch.autograd.gradcheck(quats.rotation_matrices, (random(5).requires_grad_(),))
