"""The GPU's kernels run on a CPU here. `test_backends_agree.py` and `test_stress.py` test them too."""

from __future__ import annotations

import ctypes
import re
from dataclasses import fields, replace

import pytest
import torch
from raster_scenes import Case, make_case, weights_like
from simt_runtime import SIMT, SimtRuntime, simt_backend
from stress_measure import Truth, deviation
from tolerances import GRADIENT, IMAGE
from torch import Tensor

from gsopt.errors import NumericalError, UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.raster.backend import AdamStep, Backend, Gradients, RasterSettings
from gsopt.raster.device import backend as device_backend
from gsopt.raster.device import camera, frame, runtime
from gsopt.raster.device.layout import kernels
from gsopt.raster.device.runtime import THREADS
from gsopt.raster.device.source import program


def single(case: Case) -> Case:
    return replace(case, gaussians=case.gaussians.to(torch.float32))


def everything(engine: Backend, case: Case) -> list[Tensor]:
    """All values that a step computes, those of Adam included."""
    drawn = engine.forward(case.gaussians, case.camera, case.settings, case.background, depth=True)
    gradients = engine.backward(drawn, *(v.float() for v in weights_like(case)), absgrad=True)
    loss = engine.photometric(drawn.colors, torch.full_like(drawn.colors, 0.3), 0.2)
    records = [case.gaussians.select(torch.arange(len(case.gaussians)))]
    records += [Gaussians(**{name: torch.zeros_like(t) for name, t in records[0].items()}) for _ in range(2)]
    engine.adam(records[0], replace(gradients, shN=None), *records[1:], adam_step(), case.camera, case.settings)
    assert drawn.depths is not None
    parts = [drawn.colors, drawn.alphas, drawn.depths, drawn.radii, loss.v_colors, torch.tensor([loss.l1, loss.ssim])]
    parts += [getattr(gradients, field.name) for field in fields(Gradients)]
    return parts + [tensor for record in records for _, tensor in record.items()]


def adam_step() -> AdamStep:
    return AdamStep(dict.fromkeys(PARAMETERS, 1e-2), dict.fromkeys(PARAMETERS, 3), 0.9, 0.999, 1e-15)


@pytest.mark.parametrize("settings", [RasterSettings(), RasterSettings(antialiased=True, sh_degree=1)])
def test_no_order_of_threads_and_blocks_changes_a_bit(settings: RasterSettings) -> None:
    """Whether 32 or 64 threads march together, forwards or backwards: no kernel counts on it, nothing is raced for."""
    case = single(make_case(5, count=400, width=67, height=35, settings=settings))
    first = everything(simt_backend(32), case)
    for lockstep, backwards in ((32, False), (64, False), (32, True), (64, True), (1, False), (256, True)):
        again = everything(simt_backend(lockstep, backwards), case)
        assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True)), (lockstep, backwards)


def test_segments_of_a_long_list_add_up_to_the_gradient_of_the_reference() -> None:
    case = make_case(3, count=3000, width=24, height=17)
    faint = replace(case.gaussians, logit_opacities=case.gaussians.logit_opacities * 0.2 - 3)
    case = replace(case, gaussians=faint)
    found = deviation(simt_backend(), Truth.of(case))
    assert found.image <= IMAGE
    assert found.gradient <= GRADIENT
    context = simt_backend().forward(single(case).gaussians, case.camera, case.settings).context
    drawn = torch.bincount(context.segments.tile_of[context.segments.tile_of >= 0])
    assert drawn.tolist() == [-(-int(length) // THREADS) for length in context.entries.tile_begin.diff()]
    assert int(drawn.max()) > 3


def test_the_order_of_threads_is_really_another() -> None:
    orders = {tuple(SimtRuntime(*how)._order.threads) for how in ((32, False), (64, False), (32, True), (64, True))}
    assert len(orders) == 4
    assert all(set(order[:-1]) == set(range(runtime.THREADS)) for order in orders)


def test_a_record_is_as_large_as_its_compiler_has_it() -> None:
    for name, record in kernels(program()).items():
        assert ctypes.sizeof(record) == SimtRuntime().size_of(name), name


def test_numbers_that_python_and_kernels_share_are_the_same() -> None:
    text = program()

    def told(name: str) -> float:
        match = re.search(rf"\b{name} = ([\d.]+)", text)
        assert match, name
        return float(match[1])

    assert told("kThreads") == runtime.THREADS
    assert told("kTile") == frame.TILE
    assert told("kEndFields") == frame.END_FIELDS
    assert told("kBandGroup") == device_backend.BAND_GROUP
    assert f"AdamTensor of[{device_backend.MOST_TENSORS}];" in text
    assert told("kViewMargin") == pytest.approx(camera.VIEW_MARGIN)
    fields_of_sums = re.search(r"enum RowField \{([^}]*), kRowFields \}", text)
    assert fields_of_sums
    assert len(fields_of_sums[1].split(",")) == frame.SUM_FIELDS
    record = re.search(r"Record \{\s*float ([^;]*);\s*unsigned short ([^;]*);", text)
    assert record
    assert len(record[1].split(",")) + len(record[2].split(",")) / 2 == frame.RECORD_FLOATS


def test_the_text_includes_every_file_once() -> None:
    for text in (program(), program(SIMT)):
        assert not re.search(r'#include "', text)
        assert text.count("struct Camera {") == text.count("KERNEL(blend, ") == text.count("#define SHARED") == 1


@pytest.mark.parametrize(("stored", "drawn_degree"), [(3, 3), (3, 1), (2, 2), (1, 3), (0, 3)])
def test_adam_needs_no_gradient_of_the_bands(stored: int, drawn_degree: int) -> None:
    """Adam finds the gradient of the bands from that of sh0; the step equals one that is given it, to the last bit."""
    settings = RasterSettings(sh_degree=drawn_degree)
    case = single(make_case(6, count=77, width=40, height=36, settings=settings, sh_degree=stored))
    ends = []
    for bands in (True, False):
        backend = simt_backend()
        drawn = backend.forward(case.gaussians, case.camera, settings, case.background)
        gradients = backend.backward(drawn, weights_like(case)[0].float(), bands=bands)
        records = [case.gaussians.select(torch.arange(77))]
        records += [Gaussians(**{name: torch.zeros_like(t) for name, t in records[0].items()}) for _ in range(2)]
        backend.adam(records[0], gradients, *records[1:], adam_step(), case.camera, settings)
        ends.append(records)
    for given, found in zip(*ends, strict=True):
        for name, tensor in given.items():
            assert torch.equal(tensor, getattr(found, name)), name


def test_an_image_of_more_tiles_than_a_short_holds() -> None:
    """Tiles are numbered by 32 bits then; the pixels stay the same."""
    case = single(make_case(5, count=60, width=67, height=35))
    expected = everything(simt_backend(), case)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame, "MOST_SHORT_TILES", 0)
        got = everything(simt_backend(), case)
    assert all(torch.equal(one, other) for one, other in zip(expected, got, strict=True))


def test_more_pairs_than_can_be_numbered_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame, "MOST_ENTRIES", 10)
    case = single(make_case(5, count=60, width=67, height=35))
    with pytest.raises(NumericalError, match=r"pairs of a splat and a tile are more than .* \(10\). Draw fewer"):
        simt_backend().forward(case.gaussians, case.camera, case.settings)


def test_a_frame_is_used_once() -> None:
    case, backend = single(make_case(5, count=20)), simt_backend()
    drawn = backend.forward(case.gaussians, case.camera, case.settings)
    backend.backward(drawn, weights_like(case)[0].float())
    with pytest.raises(UsageError, match="used before"):
        backend.backward(drawn, weights_like(case)[0].float())
    released = backend.forward(case.gaussians, case.camera, case.settings)
    backend.release(released)
    with pytest.raises(UsageError, match="used before"):
        backend.backward(released, weights_like(case)[0].float())


def test_gaussians_elsewhere_are_refused() -> None:
    case = single(make_case(5, count=20))
    with pytest.raises(UsageError, match=r"draws Gaussians on cpu, got them on meta. Move them"):
        simt_backend().forward(case.gaussians.to("meta"), case.camera, case.settings)


@pytest.mark.parametrize("how", ["turned", "double"])
def test_a_step_of_a_copy_is_refused(how: str) -> None:
    """What is not float32 or not contiguous would have to be copied, and the copy would be stepped."""
    case, backend = single(make_case(3, count=30)), simt_backend()
    drawn = backend.forward(case.gaussians, case.camera, case.settings)
    gradients = backend.backward(drawn, weights_like(case)[0].float())
    means = case.gaussians.means
    wrong = replace(case.gaussians, means=means.T.contiguous().T if how == "turned" else means.double())
    moments = [Gaussians(**{name: torch.zeros_like(t) for name, t in case.gaussians.items()}) for _ in range(2)]
    with pytest.raises(UsageError, match="means"):
        backend.adam(wrong, gradients, *moments, adam_step(), case.camera, case.settings)
