"""Numbers that no sane scene holds: the compiled backend draws them as the float64 reference does, or refuses them.

`GSOPT_STRESS=full` (`make stress`) takes the sizes that the claims are made for; without it the same laws are checked
on sizes that suit a continuous integration.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import fields, replace
from functools import cache
from pathlib import Path

import pytest
import torch
from fake_mps import KERNEL_TEXTS
from raster_scenes import Case
from stress_cases import STRESSES, Stress
from stress_measure import Truth, deviation
from stress_scenes import ahead, crowd, layers, scales, scene
from tolerances import UNDECIDED_SHARE
from torch import Tensor

from gsopt.errors import InputError, UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.api import make_backend, rasterize
from gsopt.raster.backend import TRANSMITTANCE_MIN, AdamStep, Backend, Gradients, RasterSettings
from gsopt.training.optimizer import OptimizedGaussians

FULL = os.environ.get("GSOPT_STRESS") == "full"
MANY = 5_000_000 if FULL else 100_000
STEPS = 100_000 if FULL else 300
KERNELS = [*_cpu.instruction_sets(), "simt"]
PERFORMANCE = Path(__file__).resolve().parents[2] / "docs" / "performance.md"


@pytest.fixture(params=KERNELS)
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Backend:
    """The compiled backend on every instruction set of this processor, and the kernels of GPUs on it."""
    if request.param in KERNEL_TEXTS:
        return KERNEL_TEXTS[request.param]()
    monkeypatch.setenv("GSOPT_ISA", request.param)
    return make_backend("cpu", 2)


@cache
def truth(stress: Stress) -> Truth:
    return Truth.of(stress.make())


@pytest.mark.parametrize("backend", [*KERNELS, "metal"], indirect=True)
@pytest.mark.parametrize("stress", STRESSES, ids=lambda stress: stress.name)
def test_it_is_drawn_and_differentiated_as_by_the_reference(backend: Backend, stress: Stress) -> None:
    found = deviation(backend, truth(stress))
    assert found.undecided <= UNDECIDED_SHARE
    assert found.image <= stress.image
    assert found.gradient <= stress.gradient, found.worst


def test_the_layers_hold_a_saturated_and_a_living_pixel_in_one_block() -> None:
    alphas = truth(next(stress for stress in STRESSES if stress.make is layers)).frame.alphas
    blocks = alphas.view(4, 4, 4, 4).transpose(1, 2).reshape(16, 16)
    assert bool(((blocks.amax(dim=1) > 1 - TRANSMITTANCE_MIN) & (blocks.amin(dim=1) < 0.9)).any())


def test_the_table_in_the_docs_is_of_these_cases() -> None:
    rows = [
        line.split("|")[1:4] for line in PERFORMANCE.read_text(encoding="utf-8").splitlines() if line.count("|") > 4
    ]
    told = {tuple(cell.strip() for cell in row) for row in rows}
    assert {(stress.name, stress.risk, stress.outcome) for stress in STRESSES} <= told


# ---- what never enters a kernel


def broken(tensor: Tensor, value: float) -> tuple[Tensor, str]:
    """A copy with one element replaced near its end, and that element's index as an error names it."""
    copy = tensor.clone()
    copy.view(-1)[-2] = value
    return copy, str([int(i) for i in torch.unravel_index(torch.tensor(copy.numel() - 2), copy.shape)])


def plain() -> Case:
    return scene(crowd())


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300], ids=str)
@pytest.mark.parametrize("name", [*PARAMETERS, "viewmats", "Ks", "background"])
def test_what_is_not_finite_is_refused_by_name_and_index(name: str, value: float) -> None:
    case = plain()
    parts = {**dict(case.gaussians.items()), "viewmats": case.camera.viewmats, "Ks": case.camera.Ks}
    tensor, index = broken({**parts, "background": case.background}[name], value)
    gaussians = replace(case.gaussians, **{name: tensor}) if name in PARAMETERS else case.gaussians
    camera = replace(case.camera, **{name: tensor}) if name in ("viewmats", "Ks") else case.camera
    background = tensor if name == "background" else case.background
    with pytest.raises(InputError, match=re.escape(f"`{name}` must be finite") + ".*" + re.escape(index)):
        rasterize(gaussians, camera, background=background, backend="cpu")


@pytest.mark.parametrize("norm", [0.0, 1e-40, 1e-31])
def test_a_quaternion_without_a_direction_is_refused_by_row(norm: float) -> None:
    case = plain()
    quats = case.gaussians.quats.clone()
    quats[7] = norm * torch.tensor([1.0, 1.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"`quats` must not be zero.*at row 7"):
        rasterize(replace(case.gaussians, quats=quats), case.camera, backend="cpu")


@pytest.mark.parametrize("name", ["near_plane", "far_plane", "eps2d"])
@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_a_setting_that_is_no_number_is_refused(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=f"`{name}`"):
        RasterSettings(**{name: value})


# ---- many


def test_what_is_behind_the_camera_changes_no_bit(backend: Backend) -> None:
    count, step = MANY, MANY // 500
    parameters = crowd(count)
    parameters["means"][:, 2] = -10.0 - parameters["means"][:, 2].abs()
    seen = torch.arange(0, count, step)
    parameters["means"][seen, 2] = 0.0
    gaussians = Gaussians(**parameters)
    camera, settings = ahead(), RasterSettings()
    all_of_them = backend.forward(gaussians, camera, settings)
    few = backend.forward(gaussians.select(seen), camera, settings)
    assert torch.equal(all_of_them.colors, few.colors)
    assert torch.equal(all_of_them.radii[seen], few.radii)
    assert int(all_of_them.radii.sum()) == int(few.radii.sum()) > 0
    v_colors = torch.ones_like(few.colors)
    of_all, of_few = backend.backward(all_of_them, v_colors), backend.backward(few, v_colors)
    for name in PARAMETERS:
        assert torch.equal(getattr(of_all, name)[seen], getattr(of_few, name)), name
        assert int(getattr(of_all, name).count_nonzero()) == int(getattr(of_few, name).count_nonzero()), name


def test_many_in_front_of_few_pixels(backend: Backend) -> None:
    count = MANY
    faint = crowd(count, log_scales=scales(0.01, count=count), logit_opacities=torch.full((count,), -5.0))
    gaussians, camera, settings = Gaussians(**faint), ahead(8, 8), RasterSettings()
    frame = backend.forward(gaussians, camera, settings)
    assert int((frame.radii > 0).all(dim=1).sum()) > 0.5 * count
    expected = make_backend("reference").forward(gaussians.to(torch.float64), camera, settings)
    # Hundreds of layers of one part in 150: all round to the same side.
    assert float((frame.colors - expected.colors).abs().max()) < 1e-4
    gradients = backend.backward(frame, torch.ones_like(frame.colors), absgrad=True)
    assert all(bool(torch.isfinite(getattr(gradients, field.name)).all()) for field in fields(Gradients))


# ---- long


@pytest.mark.parametrize("rate", [0.3, 10.0, 1e6, 1e30])
def test_a_hostile_learning_rate_leaves_numbers(backend: Backend, rate: float) -> None:
    case = plain()
    model = OptimizedGaussians.start(case.gaussians.to(torch.float32))
    target = torch.rand(28, 40, 3, generator=torch.Generator().manual_seed(0))
    for step in range(1, STEPS + 1):
        frame = backend.forward(model.gaussians, case.camera, case.settings, case.background)
        loss = backend.photometric(frame.colors, target, 0.2)
        gradients = backend.backward(frame, loss.v_colors, bands=False)
        assert math.isfinite(loss.loss), step
        adam = AdamStep(dict.fromkeys(PARAMETERS, rate), dict.fromkeys(PARAMETERS, step), 0.9, 0.999, 1e-15)
        backend.adam(model.gaussians, gradients, model.exp_avg, model.exp_avg_sq, adam, case.camera, case.settings)
        for name, param in model.gaussians.items():
            assert bool(torch.isfinite(param).all()), (name, step)
