"""Distances in a grid: those of all pairs, by every instruction set."""

from __future__ import annotations

import pytest
import torch

from gsopt.data.distances import FAR_SQUARED, squared_distance
from gsopt.raster import _cpu
from gsopt.raster.cpu_backend import ISA_VARIABLE


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
@pytest.mark.parametrize("shape", [(9, 7, 11), (3, 20, 300), (40, 1, 1)])
def test_the_distance_is_that_of_all_pairs(shape: tuple[int, ...], isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ISA_VARIABLE, isa)
    cells = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < 0.02
    cells[0, 0, 0] = True
    everywhere = torch.nonzero(torch.ones_like(cells)).double()
    exact = torch.cdist(everywhere, torch.nonzero(cells).double()).amin(1).square().round()
    assert torch.equal(squared_distance(cells, max(shape)).flatten().double(), exact.clamp(max=FAR_SQUARED))
    near = squared_distance(cells, 2).flatten().double()
    within = exact <= 4
    assert torch.equal(near[within], exact[within])
    assert bool((near >= exact.clamp(max=FAR_SQUARED)).all())
    assert bool((squared_distance(torch.zeros_like(cells), 3) == FAR_SQUARED).all())


def test_a_grid_may_have_any_strides() -> None:
    cells = torch.rand(6, 5, 4, generator=torch.Generator().manual_seed(1)) < 0.1
    assert torch.equal(squared_distance(cells.permute(2, 0, 1), 6), squared_distance(cells, 6).permute(2, 0, 1))
