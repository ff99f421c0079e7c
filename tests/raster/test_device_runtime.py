"""The way to a GPU, with a driver, a compiler and a torch that only pretend.

Each failure is one error that says what to do, and never a run on the CPU.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from pretend_gpu import GPU, pretend_gpu
from raster_scenes import make_case, weights_like
from simt_runtime import SimtRuntime, simt_backend

from gsopt.errors import MissingDependency, NumericalError, SettingError, UsageError
from gsopt.raster.api import make_backend, rasterize
from gsopt.raster.device import cache, gpu
from gsopt.raster.device.backend import MOST_TENSORS, NO_TENSOR, DeviceBackend
from gsopt.raster.device.driver import HIP_DRIVER, Driver, open_driver
from gsopt.raster.device.gpu import GpuRuntime, Tools
from gsopt.raster.device.layout import kernels
from gsopt.raster.device.source import program


class FakeLibrary:
    """libcuda: takes code that begins as `good` says, and runs its kernels on this CPU."""

    def __init__(self, load_status: int = 0, launch_status: int = 0) -> None:
        self.load_status, self.launch_status = load_status, launch_status
        self.launched: list[str] = []
        self._names: list[str] = []
        self._thread = threading.local()
        self._thread.context = 5  # as torch leaves it in the thread that asks for the GPU

    def cuDriverGetVersion(self, number: Any) -> int:
        number._obj.value = 12040
        return 0

    def cuGetErrorString(self, status: int, text: Any) -> int:
        known = {2: b"out of memory", 222: b"the provided PTX was compiled with an unsupported toolchain."}
        text._obj.value = known.get(status, b"an illegal memory access was encountered")
        return 0

    def cuCtxGetCurrent(self, context: Any) -> int:
        context._obj.value = getattr(self._thread, "context", None)
        return 0

    def cuCtxSetCurrent(self, context: Any) -> int:
        self._thread.context = context.value
        return 0

    def cuModuleLoadData(self, module: Any, code: bytes) -> int:
        module._obj.value = 1
        return self.load_status

    def cuModuleGetFunction(self, function: Any, module: Any, name: bytes) -> int:
        self._names.append(name.decode())
        function._obj.value = len(self._names)
        return 0

    def cuLaunchKernel(self, function: Any, *rest: Any) -> int:
        if getattr(self._thread, "context", None) != 5:
            return 201
        name = self._names[function.value - 1]
        blocks, threads, values = rest[0].value, rest[3].value, rest[8]
        assert threads == 256
        self.launched.append(name)
        record = kernels(program())[name].from_address(values[0])
        SimtRuntime().run(name, blocks, record)
        return self.launch_status


class FakeCompiler:
    """NVRTC up to sm_90."""

    version, path = "13.0", "libnvrtc.so.13"

    def __init__(self) -> None:
        self.compiled: list[str] = []

    def newest(self, arch: str) -> str:
        return arch if int(arch[3:]) <= 90 else "compute_90"

    def compile(self, text: str, arch: str) -> bytes:
        self.compiled.append(arch)
        return b"code for " + arch.encode()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeLibrary:
    """One GPU, as torch sees it."""
    library = FakeLibrary()
    stream = SimpleNamespace(cuda_stream=7)
    monkeypatch.setenv("GSOPT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("torch.version.cuda", "13.0")
    for name, value in {
        "is_available": lambda: True,
        "device_count": lambda: 2,
        "current_device": lambda: 0,
        "device": lambda device: contextlib.nullcontext(),
        "current_stream": lambda device: stream,
        "get_device_name": lambda device: "Pretended GPU",
        "get_device_capability": lambda device: (9, 0),
    }.items():
        monkeypatch.setattr(f"torch.cuda.{name}", value)
    return library


def tools(library: FakeLibrary, compiler: FakeCompiler | None = None) -> Tools:
    return Tools(compiler or FakeCompiler(), Driver(library))  # type: ignore[arg-type]


def test_a_kernel_gets_its_record_through_the_driver(machine: FakeLibrary) -> None:
    case = make_case(5, count=40, width=37, height=20)
    single = case.gaussians.to(torch.float32)
    expected = simt_backend().forward(single, case.camera, case.settings, case.background)
    with pretend_gpu():
        backend = DeviceBackend(GpuRuntime(GPU, tools(machine)))
        frame = backend.forward(single.to(GPU), case.camera, case.settings, case.background)
        gradients = backend.backward(frame, weights_like(case)[0].float().to(GPU))
        colors, means = frame.colors.cpu(), gradients.means.cpu()
    assert torch.equal(colors, expected.colors)
    assert bool((means != 0).any())
    assert machine.launched == [
        "project_gaussians",
        "list_tiles",
        "blend",
        "blend_backward",
        "project_backward_gaussians",
    ]
    assert backend.runtime.about["device"] == "Pretended GPU (cuda:0)"
    assert backend.runtime.about["arch"] == "sm_90"
    assert "driver for CUDA 12.4" in backend.runtime.about["library"]


def test_a_thread_without_a_context_gets_the_one_of_torch(machine: FakeLibrary) -> None:
    """As that in which autograd calls `backward`."""
    with pretend_gpu():
        runtime = GpuRuntime(GPU, tools(machine))
    nothing = {"rates": {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}, "tensors": 0, "of": [NO_TENSOR] * MOST_TENSORS}
    with ThreadPoolExecutor(1) as pool:
        pool.submit(runtime.launch, "adam", 1, nothing).result()
    assert machine.launched == ["adam"]


def test_kernels_are_compiled_once(machine: FakeLibrary, tmp_path: Path) -> None:
    compiler = FakeCompiler()
    with pretend_gpu():
        for _ in range(2):
            GpuRuntime(GPU, tools(machine, compiler))
        assert compiler.compiled == ["sm_90"]
        (stored,) = (tmp_path / "cache").iterdir()
        stored.write_bytes(stored.read_bytes()[:-1])  # a disk that was full, say
        GpuRuntime(GPU, tools(machine, compiler))
    assert compiler.compiled == ["sm_90", "sm_90"]


@pytest.mark.parametrize(
    ("where", "other"),
    [
        ("gsopt.raster.device.gpu.program", lambda: program() + "// another"),
        ("torch.cuda.get_device_capability", lambda device: (8, 0)),
        ("test_device_runtime.FakeCompiler.version", "13.1"),
        ("test_device_runtime.FakeCompiler.path", "/elsewhere/libnvrtc.so.13"),
    ],
)
def test_another_text_gpu_or_compiler_compiles_anew(
    where: str, other: Any, machine: FakeLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = FakeCompiler()
    with pretend_gpu():
        GpuRuntime(GPU, tools(machine, compiler))
        monkeypatch.setattr(where, other)
        for _ in range(2):
            GpuRuntime(GPU, tools(machine, compiler))
    assert len(compiler.compiled) == 2


def test_a_torch_without_nvrtc_is_told(machine: FakeLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*args: Any) -> None:
        raise ImportError("nothing of that name")

    monkeypatch.setattr("gsopt.raster.device.compiler.installed", lambda dialect: [])
    monkeypatch.setattr("gsopt.raster.device.compiler.CudaCore", missing)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    for backend in ("cuda", "auto"):
        with pytest.raises(MissingDependency, match=r"needs the library nvrtc 13.*pip install nvidia-cuda-nvrtc"):
            make_backend(backend)


def test_a_cache_that_refuses_costs_only_time(machine: FakeLibrary, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder would be")
    assert cache.cached("key", lambda: b"made") == b"made"


def test_a_newer_gpu_gets_what_its_driver_translates(machine: FakeLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.get_device_capability", lambda device: (13, 1))
    compiler = FakeCompiler()
    with pretend_gpu():
        GpuRuntime(GPU, tools(machine, compiler))
    assert compiler.compiled == ["compute_90"]


def test_a_driver_that_is_too_old_is_told_with_its_version(machine: FakeLibrary) -> None:
    machine.load_status = 222
    with pretend_gpu(), pytest.raises(MissingDependency, match=r"\(CUDA 12\.4\) refuses .*newer driver.*--backend cpu"):
        GpuRuntime(GPU, tools(machine))


@pytest.mark.parametrize(("status", "words"), [(700, "illegal memory access"), (2, "out of memory")])
def test_a_kernel_that_fails_says_how_to_go_on(machine: FakeLibrary, status: int, words: str) -> None:
    machine.launch_status = status
    case = make_case(5, count=4, width=17, height=9)
    with pretend_gpu():
        backend, gaussians = DeviceBackend(GpuRuntime(GPU, tools(machine))), case.gaussians.to(torch.float32).to(GPU)
        with pytest.raises(NumericalError, match=rf"{words}.*\({status}\).*--resume --backend cpu"):
            backend.forward(gaussians, case.camera, case.settings)


def test_without_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    for dialect in ((), (HIP_DRIVER,)):
        with pytest.raises(MissingDependency, match=r"driver .* is not there. Install the driver.*--backend cpu"):
            open_driver(*dialect)


def test_a_torch_for_cpus_is_told_with_the_pip_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.version.cuda", None)
    with pytest.raises(MissingDependency, match=r"is built for CPUs.*pip install torch"):
        make_backend("cuda")


def test_no_gpu_is_told(machine: FakeLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(MissingDependency, match=r"finds no GPU.*nvidia-smi.*--backend cpu"):
        make_backend("cuda")


def test_a_gpu_that_is_not_there(machine: FakeLibrary) -> None:
    with pytest.raises(UsageError, match=r"`device` is cuda:2, but there are 2 GPUs: cuda:0 to cuda:1"):
        gpu.chosen_device("cuda:2")
    assert gpu.chosen_device("cuda:1") == torch.device("cuda", 1)
    assert gpu.chosen_device("cuda") == torch.device("cuda", 0)


@pytest.mark.parametrize("device", ["gpu", "cuda:", "cuda:-1", "cuda:1234", "cuda:0; rm", "\N{DIGIT ONE}" * 5000, 1])
def test_a_device_that_is_none(device: Any) -> None:
    with pytest.raises(SettingError, match="`device` must be cpu, cuda, mps or a GPU as cuda:1, got"):
        make_backend("auto", 0, device)


def test_auto_takes_the_gpu_and_never_silently_the_cpu(machine: FakeLibrary, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsopt.raster.device.gpu.gpu_runtime", lambda name: SimtRuntime())
    assert make_backend("auto").name == "simt"
    assert make_backend("auto", 1, "cuda:1").name == "simt"
    assert make_backend("auto", 1, "cpu").name == "cpu"
    case = make_case(5, count=4)
    rasterize(case.gaussians.to(torch.float32), case.camera)  # on the CPU, where they lie

    def broken(name: str) -> SimtRuntime:
        raise MissingDependency("no library")

    monkeypatch.setattr("gsopt.raster.device.gpu.gpu_runtime", broken)
    with pytest.raises(MissingDependency, match="no library"):
        make_backend("auto")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert make_backend("auto", 1).name == "cpu"
