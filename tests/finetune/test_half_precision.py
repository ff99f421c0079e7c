"""Tests of weights in half precision: 8 significant bits, nearest, infinities and zeros kept."""

from __future__ import annotations

import torch

from gsopt.finetune.half_precision import SIGNIFICANT_BITS, in_half_precision, rounded


def test_rounded_to_the_nearest_of_eight_significant_bits() -> None:
    values = torch.randn(10_000, generator=torch.Generator().manual_seed(0))
    found = rounded(values)
    steps = torch.frexp(found.float())[0] * 2**SIGNIFICANT_BITS
    assert torch.equal(steps, steps.round())
    assert float(((found.float() - values) / values).abs().max()) <= 2.0**-SIGNIFICANT_BITS
    assert torch.equal(rounded(found), found)
    assert torch.equal(rounded(torch.tensor([0.0, -1.0, 257 / 256])), torch.tensor([0.0, -1.0, 1.0]).half())


def test_a_model_is_converted_in_place() -> None:
    model = torch.nn.Linear(7, 5)
    before = model.weight.detach().clone()
    assert in_half_precision(model) is model
    assert model.weight.dtype == torch.float16
    assert torch.equal(model.weight, rounded(before.half()))
