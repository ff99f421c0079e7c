"""The way to Apple's GPU, with a torch that only pretends to have one: fake_mps.py runs the kernels on this CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from fake_mps import FakeKernel, fake_mps, metal_backend
from pretend_gpu import APPLE
from raster_scenes import make_case, weights_like
from simt_runtime import simt_backend
from test_device_kernels import everything, single

from gsopt.errors import MissingDependency, NumericalError, UsageError
from gsopt.raster.api import make_backend, rasterize
from gsopt.raster.backend import RasterSettings
from gsopt.raster.device import mps
from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.device.memory import free_bytes
from gsopt.raster.device.metal import metal_program
from gsopt.raster.device.mps import mps_runtime


@pytest.mark.parametrize("settings", [RasterSettings(), RasterSettings(antialiased=True, sh_degree=1)])
def test_no_order_of_threads_and_blocks_changes_a_bit(settings: RasterSettings) -> None:
    """The threads of a block take turns from barrier to barrier, in any order: nothing is raced for. And the bits are
    those of the other dialect: what blend_backward takes at a time changes none."""
    case = single(make_case(5, count=400, width=67, height=35, settings=settings))
    first = everything(simt_backend(), case)
    for lockstep, backwards in ((32, False), (32, True), (64, False), (1, True), (256, False)):
        again = everything(metal_backend(lockstep, backwards), case)
        assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True)), (lockstep, backwards)


def test_a_kernel_gets_its_numbers_and_its_buffers() -> None:
    case = single(make_case(5, count=40, width=37, height=20))
    expected = simt_backend().forward(case.gaussians, case.camera, case.settings, case.background)
    with fake_mps() as libraries:
        backend = DeviceBackend(mps_runtime())
        frame = backend.forward(case.gaussians.to(APPLE), case.camera, case.settings, case.background)
        gradients = backend.backward(frame, weights_like(case)[0].float().to(APPLE))
        colors, means = frame.colors.cpu(), gradients.means.cpu()
    assert torch.equal(colors, expected.colors)
    assert bool((means != 0).any())
    (library,) = libraries
    assert library.launched == [
        "project_gaussians",
        "list_tiles",
        "blend",
        "blend_backward",
        "project_backward_gaussians",
    ]
    assert (backend.name, backend.device) == ("mps", APPLE)
    assert "torch.mps.compile_shader" in backend.runtime.about["library"]


def test_nothing_to_draw_needs_no_buffer() -> None:
    case = single(make_case(5, count=3, width=17, height=9))
    behind = case.gaussians.select(torch.arange(3))
    behind.means[:, 2] = -100.0
    for gaussians in (behind, case.gaussians.select(torch.arange(0))):
        with fake_mps():
            drawn = make_backend("mps").forward(gaussians.to(APPLE), case.camera, case.settings)
            alphas = drawn.alphas.cpu()
        assert bool((alphas == 0).all())


def test_auto_takes_apples_gpu() -> None:
    case = single(make_case(5, count=4))
    with fake_mps():
        assert make_backend("auto").name == make_backend("auto", 1, "mps").name == make_backend("mps").name == "mps"
        assert make_backend("auto", 1, "cpu").name == make_backend("cpu").name == "cpu"
        drawn = rasterize(case.gaussians.to(APPLE), case.camera)
        assert drawn.colors.device == APPLE


def test_a_torch_without_metal_is_told() -> None:
    with pytest.raises(MissingDependency, match=r"not built for Apple's GPUs.*pip install torch.*--backend cpu"):
        make_backend("mps")


def test_a_mac_without_a_gpu_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.backends.mps.is_built", lambda: True)
    with pytest.raises(MissingDependency, match=r"finds no GPU of Apple.*macOS 14.*--backend cpu"):
        make_backend("mps")


@pytest.mark.parametrize(
    ("backend", "device", "message"),
    [
        ("mps", "mps:1", "`device` is mps:1, but the backend mps has one GPU"),
        ("mps", "cuda:0", "`device` is cuda, but `backend` is mps"),
        ("cuda", "mps", "`device` is mps, but `backend` is cuda"),
        ("cuda", "cpu", "`device` is cpu, but `backend` is cuda"),
    ],
)
def test_a_device_that_the_backend_has_not(backend: str, device: str, message: str) -> None:
    with fake_mps(), pytest.raises(UsageError, match=message):
        make_backend(backend, 1, device)


@pytest.mark.parametrize("error", [SyntaxError("program_source:3: error"), RuntimeError("program_source:3: error")])
def test_a_text_that_does_not_compile_is_told(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(source: str) -> None:
        raise error

    with fake_mps():
        monkeypatch.setattr(torch.mps, "compile_shader", broken)
        with pytest.raises(MissingDependency, match=r"cannot compile.*program_source:3: error.*--backend cpu"):
            make_backend("mps")


def test_a_gpu_of_too_few_threads_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeKernel, "max_threads_per_threadgroup", 128)
    with fake_mps(), pytest.raises(MissingDependency, match=r"at most 128 threads of the kernel `\w+`.*needs 256"):
        make_backend("mps")


def test_a_gpu_that_computes_wrong_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another trainer met gradients on Apple's GPUs that are zero, without an error."""
    monkeypatch.setattr(mps, "metal_program", lambda: metal_program().replace("sum += in.sums", "sum += 0.f * in.sums"))
    with (
        fake_mps(),
        pytest.raises(NumericalError, match=r"mps:0 computes a test image wrong \(v_means by 1, .*--backend cpu"),
    ):
        make_backend("mps")


def test_memory_that_is_free() -> None:
    with fake_mps():
        torch.mps.driver_allocated_memory = lambda: 10**9
        assert free_bytes(APPLE) == 10**12 - 10**9


def test_the_end_of_memory_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError("MPS backend out of memory (MPS allocated: 8.00 GB, max allowed: 9.07 GB).")

    case = single(make_case(5, count=4, width=17, height=9))
    with fake_mps():
        backend = make_backend("mps")
        monkeypatch.setattr(FakeKernel, "__call__", full)
        with pytest.raises(NumericalError, match=r"needs more memory than there is: MPS backend out of memory"):
            backend.forward(case.gaussians.to(APPLE), case.camera, case.settings)
