"""Laws of frozen surroundings: they are drawn with the Gaussians of the run, and nothing changes them."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from tiny_scenes import cloud, ring, tiny_config

from gsopt.config.cells import CellConfig
from gsopt.config.train import SparseConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.formats import load_splats
from gsopt.formats.ply import save_ply
from gsopt.gaussians import Gaussians
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Gradients, RasterSettings
from gsopt.training.loop import train
from gsopt.training.surroundings import Surrounded

SETTINGS = RasterSettings(sh_degree=1)


def gradients(backend: Surrounded, own: Gaussians, v_colors: torch.Tensor, view: int = 0) -> Gradients:
    return backend.backward(backend.forward(own, ring(3, 1.0)[view], SETTINGS), v_colors)


@pytest.fixture
def v_colors() -> torch.Tensor:
    return torch.rand(24, 24, 3, generator=torch.Generator().manual_seed(3)) - 0.5


def test_they_are_drawn_with_the_run_and_its_gradients_are_those_of_all(v_colors: torch.Tensor) -> None:
    own, frozen, engine = cloud(30, 1), cloud(20, 2), make_backend("cpu", 1)
    backend, all_of_them = Surrounded(engine, frozen), own.append(frozen)
    for view in (0, 1):  # the second frame finds memory of the first
        moved = replace(own, means=own.means + 0.01 * view)
        both = replace(all_of_them, means=torch.cat([moved.means, frozen.means]))
        frame, whole = (b.forward(g, ring(3, 1.0)[view], SETTINGS) for b, g in ((backend, moved), (engine, both)))
        assert torch.equal(frame.colors, whole.colors)
        assert torch.equal(frame.radii, whole.radii[:30])
        found, expected = backend.backward(frame, v_colors), engine.backward(whole, v_colors)
        for field in fields(Gradients):
            mine, theirs = getattr(found, field.name), getattr(expected, field.name)
            assert (mine is None) == (theirs is None)
            assert mine is None or torch.equal(mine, theirs[:30]), field.name


def test_pixels_count_by_what_the_frozen_ones_leave_of_them(v_colors: torch.Tensor) -> None:
    own, engine = cloud(30, 1), make_backend("cpu", 1)
    hidden = replace(own, logit_opacities=own.logit_opacities - 100)
    alone = engine.backward(engine.forward(own.append(hidden), ring(3, 1.0)[0], SETTINGS), v_colors)
    whole = gradients(Surrounded(engine, hidden, first=own), own, v_colors)
    assert torch.equal(whole.means, alone.means[:30])
    wall = replace(own, log_scales=own.log_scales + 4, logit_opacities=own.logit_opacities + 50)
    covered = gradients(Surrounded(engine, wall, first=hidden), own, v_colors)
    assert float(covered.sh0.norm()) < 0.05 * float(alone.sh0.norm())
    other = cloud(30, 2)
    part = gradients(Surrounded(engine, other, first=own), own, v_colors)
    plain = gradients(Surrounded(engine, other), own, v_colors)
    assert 0 < float(part.sh0.norm()) < float(plain.sh0.norm())


def test_a_run_starts_from_splats_and_leaves_the_frozen_ones_out(dataset: Path, tmp_path: Path) -> None:
    start, frozen = tmp_path / "start.ply", tmp_path / "frozen.ply"
    save_ply(start, cloud(40, 1))
    save_ply(frozen, cloud(25, 2))
    before = frozen.read_bytes()
    names = [view.name for view in load_scene(str(dataset)).train]
    cell = CellConfig(str(start), str(frozen), (names[3], names[1]))
    base = replace(tiny_config(dataset), sparse=SparseConfig(below_views=0), iterations=1)
    result = train(replace(base, cell=cell), tmp_path / "run")
    assert len(result.gaussians) == 40
    assert [view.name for view in result.scene.train] == [names[3], names[1]]
    assert (result.gaussians.means.sort(0).values - cloud(40, 1).means.sort(0).values).abs().max() < 0.02
    assert frozen.read_bytes() == before
    alone = train(replace(base, cell=replace(cell, frozen="")), tmp_path / "alone")
    assert not torch.equal(alone.gaussians.sh0, result.gaussians.sh0)
    assert len(load_splats(tmp_path / "run" / "splat.ply")) == 40


def test_a_view_or_file_that_is_not_there_is_an_input_error(dataset: Path, tmp_path: Path) -> None:
    for cell, told in ((CellConfig(views=("nobody.png",)), "nobody.png"), (CellConfig(frozen="/no/such.ply"), "such")):
        with pytest.raises(InputError, match=told):
            train(replace(tiny_config(dataset), cell=cell), tmp_path / "run")
