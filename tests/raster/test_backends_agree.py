"""Every backend draws the image, and the gradient, of the float64 reference."""

from __future__ import annotations

import gc
from dataclasses import fields, replace

import pytest
import torch
from fake_mps import KERNEL_TEXTS
from hypothesis import HealthCheck, assume, given, settings
from raster_scenes import Case, cases, make_case, undecided_gaussians, undecided_pixels, weights_like, with_parameter
from tolerances import (
    ADAM,
    DECISION,
    DEPTH,
    GRADIENT,
    GRADIENT_FLOOR,
    IMAGE,
    LOSS,
    NEEDLE,
    SSIM_GRADIENT,
    UNDECIDED_SHARE,
)
from torch import Tensor

from gsopt.errors import UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.raster import _cpu, cpu_backend  # type: ignore[attr-defined]
from gsopt.raster.api import make_backend
from gsopt.raster.backend import AdamStep, Backend, Gradients, RasterSettings, RenderedFrame
from gsopt.raster.cpu_backend import ISA_VARIABLE, CpuBackend
from gsopt.raster.reference import ReferenceBackend, extents, project

ORACLE = ReferenceBackend()
drawn = settings(
    max_examples=20, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def built(name: str, threads: int = 2) -> Backend:
    # Not skipped where the extension is missing: a build that fails must not pass for a kernel that is right.
    return KERNEL_TEXTS[name]() if name in KERNEL_TEXTS else make_backend(name, threads)


# The reference in float32 is held to the same tolerances: they ask of no kernel what plain float32 code cannot do.
@pytest.fixture(params=["reference", "cpu", "simt", "metal"])
def backend(request: pytest.FixtureRequest) -> Backend:
    return built(request.param)


def single(case: Case) -> Case:
    return replace(case, gaussians=case.gaussians.to(torch.float32))


def draw(backend: Backend, case: Case) -> RenderedFrame:
    return backend.forward(case.gaussians, case.camera, case.settings, case.background, depth=True)


def check_images(got: RenderedFrame, expected: RenderedFrame, decided: Tensor) -> None:
    assert got.depths is not None
    assert expected.depths is not None
    assert got.colors.dtype == torch.float32
    errors = torch.cat([got.colors - expected.colors, (got.alphas - expected.alphas)[..., None]], dim=-1)
    assert float(errors[decided].abs().amax()) <= IMAGE
    depth_errors = (got.depths - expected.depths)[decided].abs()
    assert float(depth_errors.amax()) <= DEPTH * max(1.0, float(expected.depths.amax()))


def check_gradients(got: Gradients, expected: Gradients, floor: float) -> None:
    assert expected.means2d_abs is not None
    permitted = floor * float(torch.linalg.vector_norm(expected.means2d_abs))
    for field in fields(Gradients):
        mine, truth = getattr(got, field.name), getattr(expected, field.name)
        assert mine.shape == truth.shape, field.name
        error = float(torch.linalg.vector_norm(mine - truth))
        assert error <= GRADIENT * float(torch.linalg.vector_norm(truth)) + permitted, field.name


def both_gradients(backend: Backend, case: Case) -> tuple[Gradients, Gradients]:
    """Gradients of the backend and of the reference, once their images agree; undecided pixels have no weight."""
    decided = ~undecided_pixels(case, DECISION)
    expected, got = draw(ORACLE, case), draw(backend, single(case))
    check_images(got, expected, decided)
    v_colors, v_alphas, v_depths = (v * decided.view(*decided.shape, *[1] * (v.dim() - 2)) for v in weights_like(case))
    truth = ORACLE.backward(expected, v_colors, v_alphas, v_depths, absgrad=True)
    mine = backend.backward(got, v_colors.float(), v_alphas.float(), v_depths.float(), absgrad=True)
    return mine, truth


@drawn
@given(case=cases())
def test_random_scenes(backend: Backend, case: Case) -> None:
    assume(not undecided_gaussians(case, DECISION))
    undecided = undecided_pixels(case, DECISION)
    assume(float(undecided.double().mean()) <= UNDECIDED_SHARE)
    check_gradients(*both_gradients(backend, case), floor=GRADIENT_FLOOR)


@pytest.mark.parametrize(
    "setting", [RasterSettings(), RasterSettings(antialiased=True), RasterSettings(sh_degree=0, eps2d=1.0)]
)
def test_many_layers_over_several_tiles(backend: Backend, setting: RasterSettings) -> None:
    case = make_case(5, count=300, width=67, height=35, settings=setting)
    assert float(undecided_pixels(case, DECISION).double().mean()) <= UNDECIDED_SHARE
    check_gradients(*both_gradients(backend, case), floor=0)


# Not for the float32 reference: its determinant is a difference of large products, good enough in float64 only.
@pytest.mark.parametrize("name", ["cpu", "simt", "metal"])
def test_needles(name: str) -> None:
    backend = built(name)
    case = make_case(6, count=24, width=48, height=32)
    shape = torch.tensor([0.0, -4.0, -4.0], dtype=torch.float64)
    case = with_parameter(case, "log_scales", shape + 0.1 * case.gaussians.log_scales)
    axes = torch.linalg.eigvalsh(project(case.gaussians, case.camera, case.settings).cov2d)
    needles = (axes[:, 1] / axes[:, 0]).sqrt() > 10
    mine, truth = both_gradients(backend, case)
    assert int((needles & (truth.log_scales != 0).any(dim=1)).sum()) >= 5
    for name in ("means", "quats", "log_scales"):
        got, expected = getattr(mine, name)[needles], getattr(truth, name)[needles]
        error = torch.linalg.vector_norm(got - expected, dim=1)
        assert bool((error <= NEEDLE * torch.linalg.vector_norm(expected, dim=1)).all()), name


@drawn
@given(case=cases())
def test_radii_are_the_same_where_rounding_up_cannot_tip(backend: Backend, case: Case) -> None:
    assume(not undecided_gaussians(case, DECISION))
    projection = project(case.gaussians, case.camera, case.settings)
    reach = extents(projection)
    size = reach.new_tensor([case.camera.width, case.camera.height])
    to_rim = torch.minimum((projection.means2d + reach).abs(), (projection.means2d - reach - size).abs())
    tips = ((reach - reach.round()).abs() < DECISION * reach) | (to_rim < DECISION * size)
    decided = ~tips.any(dim=1)
    got, expected = draw(backend, single(case)), draw(ORACLE, case)
    assert got.radii.dtype == torch.int32
    assert torch.equal(got.radii[decided], expected.radii[decided])


def test_without_background_depth_and_extra_gradients(backend: Backend) -> None:
    case = make_case(8)
    frame = backend.forward(case.gaussians.to(torch.float32), case.camera, case.settings)
    expected = ORACLE.forward(case.gaussians, case.camera, case.settings)
    assert frame.depths is None
    assert float((frame.colors - expected.colors).abs().max()) <= IMAGE
    v_colors = weights_like(case)[0]
    got = backend.backward(frame, v_colors.float())
    truth = ORACLE.backward(expected, v_colors)
    assert got.means2d_abs is None
    for name in (*PARAMETERS, "means2d"):
        mine, true = getattr(got, name), getattr(truth, name)
        assert float(torch.linalg.vector_norm(mine - true)) <= GRADIENT * float(torch.linalg.vector_norm(true)), name


def test_no_gaussians_and_none_in_view(backend: Backend) -> None:
    case = make_case(8, count=4)
    behind = replace(case.gaussians, means=case.gaussians.means + 2 * case.camera.centers)
    for gaussians in (case.gaussians.select(torch.arange(0)), behind):
        frame = draw(backend, single(replace(case, gaussians=gaussians)))
        expected = case.background.float().expand_as(frame.colors)
        torch.testing.assert_close(frame.colors, expected, atol=0, rtol=0)
        assert float(frame.alphas.abs().max()) == 0
        assert int(frame.radii.sum()) == 0
        gradients = backend.backward(frame, torch.ones_like(frame.colors), absgrad=True)
        for field in fields(Gradients):
            assert not bool(getattr(gradients, field.name).any()), field.name


def test_a_frame_is_used_once(backend: Backend) -> None:
    # A second backward would give the frame's buffers back twice, and two later frames would share them.
    frame = draw(backend, single(make_case(1)))
    backend.backward(frame, torch.ones_like(frame.colors))
    with pytest.raises(UsageError):
        backend.backward(frame, torch.ones_like(frame.colors))


def images(height: int, width: int) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(height * 1000 + width)
    target = torch.rand(height, width, 3, generator=rng)
    return (target + 0.3 * torch.randn(height, width, 3, generator=rng)).clamp(0, 1), target


@pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 3), (16, 16), (37, 70), (9, 1607), (41, 2400)])
@pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
def test_photometric(backend: Backend, height: int, width: int, lambda_dssim: float) -> None:
    rendered, target = images(height, width)
    got = backend.photometric(rendered, target, lambda_dssim)
    expected = ORACLE.photometric(rendered.double(), target.double(), lambda_dssim)
    for name in ("l1", "ssim", "loss"):
        assert getattr(got, name) == pytest.approx(getattr(expected, name), abs=LOSS), name
    error = torch.linalg.vector_norm(got.v_colors - expected.v_colors)
    assert float(error) <= SSIM_GRADIENT * float(torch.linalg.vector_norm(expected.v_colors))


def test_a_broken_pixel_spoils_the_same_rows_for_any_number_of_threads() -> None:
    """Rows are filtered in pairs, and every band of rows must pair them alike: 0 times NaN is NaN."""
    rendered, target = images(60, 20)
    rendered[30] = torch.nan
    one, *others = (CpuBackend(threads).photometric(rendered, target, 0.2).v_colors for threads in (1, 2, 3))
    assert 0 < int(one.isnan().sum()) < one.numel()
    for other in others:
        torch.testing.assert_close(other, one, rtol=0, atol=0, equal_nan=True)


def test_equal_images_have_no_loss(backend: Backend) -> None:
    _, target = images(20, 18)
    got = backend.photometric(target, target.clone(), 0.2)
    assert got.l1 == 0
    assert got.ssim == pytest.approx(1, abs=LOSS)
    # At the maximum of SSIM the gradient is zero; sign(0) = 0 leaves nothing of L1.
    assert float(got.v_colors.abs().max()) * target.numel() <= SSIM_GRADIENT


def random_like(record: Gaussians, rng: torch.Generator, scale: float = 1.0) -> Gaussians:
    return Gaussians(**{name: scale * torch.randn(tensor.shape, generator=rng) for name, tensor in record.items()})


def adam_step(step: int, names: tuple[str, ...] = PARAMETERS) -> AdamStep:
    return AdamStep(dict.fromkeys(names, 1e-2), dict.fromkeys(PARAMETERS, step), 0.9, 0.999, 1e-15)


@pytest.mark.parametrize("count", [0, 1, 3, 333])
def test_adam(backend: Backend, count: int) -> None:
    case, rng = single(make_case(1, count=count)), torch.Generator().manual_seed(0)
    start = random_like(case.gaussians, rng)
    mine = [start, *(random_like(start, rng, 0.0) for _ in range(2))]
    truth = [record.to(torch.float64) for record in mine]
    for step in (1, 2, 3):
        grads = random_like(start, rng, 10.0 ** (-3 * step))
        gradients = Gradients(**dict(grads.items()), means2d=torch.zeros(count, 2), means2d_abs=None)
        exact = Gradients(**dict(grads.to(torch.float64).items()), means2d=torch.zeros(count, 2), means2d_abs=None)
        names = PARAMETERS[: 4 + step]  # the last ones wait
        before = [tensor.clone() for _, tensor in truth[0].items()]
        backend.adam(mine[0], gradients, mine[1], mine[2], adam_step(step, names), case.camera, case.settings)
        ORACLE.adam(truth[0], exact, truth[1], truth[2], adam_step(step, names), case.camera, case.settings)
        for got, expected in zip(mine, truth, strict=True):
            for name, old in zip(PARAMETERS, before, strict=True):
                moved = (getattr(truth[0], name) - old).abs().sum()
                scale = max(1.0, float(moved), float(old.abs().sum()))
                error = (getattr(got, name) - getattr(expected, name)).abs().sum()
                assert float(error) <= ADAM * scale, (name, step)


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
@pytest.mark.parametrize(("stored", "drawn_degree"), [(3, 3), (3, 1), (2, 2), (1, 3)])
def test_adam_needs_no_gradient_of_the_bands(
    isa: str, stored: int, drawn_degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The step that finds it from that of sh0 is the one that is given it, the kernels' to the last bit, and moves
    nothing that is not drawn."""
    monkeypatch.setenv(ISA_VARIABLE, isa)
    settings = RasterSettings(sh_degree=drawn_degree)
    case = single(make_case(6, count=77, width=40, height=36, settings=settings, sh_degree=stored))
    weights = weights_like(case)
    ends: dict[tuple[str, bool], list[Gaussians]] = {}
    for name in ("cpu", "reference"):
        for bands in (True, False):
            backend = built(name)
            gradients = backend.backward(draw(backend, case), *(w.float() for w in weights), bands=bands)
            assert (gradients.shN is not None) == bands
            records = [case.gaussians.to(torch.float32).select(torch.arange(77))]
            records += [random_like(records[0], torch.Generator().manual_seed(0), 0.0) for _ in range(2)]
            backend.adam(records[0], gradients, records[1], records[2], adam_step(1), case.camera, settings)
            ends[name, bands] = records
    for name, rtol, atol in (("cpu", 0.0, 0.0), ("reference", 1e-5, 1e-7)):
        for got, expected in zip(ends[name, False], ends[name, True], strict=True):
            for field, tensor in got.items():
                torch.testing.assert_close(tensor, getattr(expected, field), rtol=rtol, atol=atol, msg=field)
    moments = ends["cpu", False][1].shN
    drawn_rows = (min(stored, drawn_degree) + 1) ** 2 - 1
    assert bool((moments[:, :drawn_rows] != 0).any())
    assert not bool(moments[:, drawn_rows:].any())


def test_what_was_changed_is_drawn_anew() -> None:
    """The kernels' views of tensors and cameras are kept between frames."""
    case, backend = single(make_case(3, count=30)), CpuBackend(1)
    case.camera.viewmats.data = torch.from_numpy(viewmats := case.camera.viewmats.numpy().copy())
    pictures = [draw(backend, case).colors]

    def check() -> None:
        pictures.append(draw(backend, case).colors)
        torch.testing.assert_close(pictures[-1], draw(CpuBackend(1), replaced(case)).colors, rtol=0, atol=0)
        assert not torch.equal(*pictures[-2:])

    case.gaussians.means.add_(0.25)
    check()
    case.gaussians.means.data = case.gaussians.means + 0.25
    check()
    case.camera.viewmats[0, 0, 3] += 0.5
    check()
    viewmats[0, 1, 3] += 0.5  # their memory, behind torch's back
    check()


def replaced(case: Case) -> Case:
    """The same values in new records."""
    return replace(case, gaussians=replace(case.gaussians), camera=replace(case.camera))


def test_records_made_in_inference_mode_are_drawn() -> None:
    with torch.inference_mode():
        case = single(make_case(3, count=30))
        case = replace(case, camera=case.camera[0])
        drawn_there = draw(CpuBackend(1), case).colors
    torch.testing.assert_close(drawn_there, draw(CpuBackend(1), single(make_case(3, count=30))).colors, rtol=0, atol=0)


@pytest.mark.parametrize("how", ["turned", "double"])
def test_a_step_of_a_copy_is_refused(how: str) -> None:
    """What is not float32 or not contiguous would have to be copied, and the copy would be stepped."""
    case, backend = single(make_case(3, count=30)), CpuBackend(1)
    gradients = backend.backward(draw(backend, case), *(w.float() for w in weights_like(case)))
    means = case.gaussians.means
    wrong = replace(case.gaussians, means=means.T.contiguous().T if how == "turned" else means.double())
    moments = [random_like(case.gaussians, torch.Generator(), 0.0) for _ in range(2)]
    with pytest.raises(UsageError, match="means"):
        backend.adam(wrong, gradients, *moments, adam_step(1), case.camera, case.settings)


def test_views_of_records_go_with_them() -> None:
    """Views of records live as long as their records, not as long as the backend."""
    known = len(cpu_backend._handles)
    case = single(make_case(3, count=30))
    for _ in range(3):
        draw(CpuBackend(1), case)
    assert len(cpu_backend._handles) == known + 1
    del case
    gc.collect()
    assert len(cpu_backend._handles) <= known


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_neither_the_number_of_threads_nor_a_repetition_changes_a_bit(
    isa: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ISA_VARIABLE, isa)
    case = single(make_case(5, count=200, width=67, height=35))
    first = everything(built("cpu", 1), case)
    for threads in (1, 2, 3, 4, 7, 8, 16):
        engine = built("cpu", threads)
        for _ in range(2):
            again = everything(engine, case)
            assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True)), threads


def everything(engine: Backend, case: Case) -> list[Tensor]:
    """All values that a step computes."""
    frame = draw(engine, case)
    assert frame.depths is not None
    gradients = engine.backward(frame, *(v.float() for v in weights_like(case)), absgrad=True)
    loss = engine.photometric(frame.colors, images(35, 67)[1], 0.2)
    tensors = [frame.colors, frame.alphas, frame.depths, frame.radii, loss.v_colors, torch.tensor([loss.l1, loss.ssim])]
    return tensors + [getattr(gradients, field.name) for field in fields(Gradients)]


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_what_the_kernels_skip_changes_no_bit(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skipping saves work: fewer pairs of splat and tile are listed, and fewer pairs of splat and pixel are blended."""
    monkeypatch.setenv(ISA_VARIABLE, isa)
    case = single(make_case(5, count=2000, width=67, height=35))

    def drawn_with(tiles: bool, terminated: bool) -> tuple[list[Tensor], int]:
        engine = built("cpu")
        assert isinstance(engine, CpuBackend)
        workspace = engine._workspace
        workspace.skip_tiles, workspace.skip_terminated, workspace.count_work = tiles, terminated, True
        return everything(engine, case), workspace.work[0]

    skipping, least = drawn_with(True, True)
    for tiles, terminated in ((False, True), (True, False), (False, False)):
        whole, work = drawn_with(tiles, terminated)
        assert all(torch.equal(one, other) for one, other in zip(skipping, whole, strict=True)), (tiles, terminated)
        assert work > least


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_every_instruction_set_draws_the_reference(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ISA_VARIABLE, isa)
    engine = built("cpu")
    assert engine.isa == isa  # type: ignore[attr-defined]
    for seed, setting in enumerate((RasterSettings(), RasterSettings(antialiased=True))):
        case = make_case(5 + seed, count=150, width=45, height=35, settings=setting)
        check_gradients(*both_gradients(engine, case), floor=0)


def test_the_depths_and_alphas_alone_are_differentiated_as_by_the_reference(backend: Backend) -> None:
    case = make_case(8, count=30)
    decided = ~undecided_pixels(case, DECISION)
    none, v_alphas, v_depths = (v * decided.view(*decided.shape, *[1] * (v.dim() - 2)) for v in weights_like(case))
    for weights in ((0 * none, v_alphas, None), (0 * none, None, v_depths)):
        truth = ORACLE.backward(draw(ORACLE, case), *weights)
        got = backend.backward(draw(backend, single(case)), *(None if v is None else v.float() for v in weights))
        for name in PARAMETERS:
            mine, true = getattr(got, name), getattr(truth, name)
            error = float(torch.linalg.vector_norm(mine - true))
            assert error <= GRADIENT * float(torch.linalg.vector_norm(true)), name
        assert float(got.sh0.abs().max()) == 0
