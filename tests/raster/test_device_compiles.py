"""NVRTC compiles the kernels for every generation of NVIDIA's GPUs: neither a GPU nor a driver is needed."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import pytest

from gsopt.errors import MissingDependency
from gsopt.raster.device import compiler
from gsopt.raster.device.compiler import CUDA, HIP, Compiler, builtins_beside, find_compiler
from gsopt.raster.device.cuda_core import CudaCore
from gsopt.raster.device.layout import kernels
from gsopt.raster.device.source import program

ARCHS = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")


def no_package() -> None:
    raise ImportError("no cuda-core")


@functools.cache
def nvrtc() -> Compiler:
    try:
        found = find_compiler()
        assert isinstance(found, Compiler)
        return found
    except MissingDependency as error:  # no such library on a Mac
        pytest.skip(str(error))


def cuda_core() -> CudaCore:
    nvrtc()
    return CudaCore()


@pytest.mark.parametrize("arch", ARCHS)
def test_every_kernel_compiles(arch: str) -> None:
    code = nvrtc().compile(program(), arch)
    assert code.startswith(b"\x7fELF")
    for name in kernels(program()):
        assert f".text.{name}\0".encode() in code, name


@pytest.mark.parametrize("arch", ["gfx906", "gfx908", "gfx90a", "gfx1030"])
def test_every_kernel_compiles_for_amd(arch: str) -> None:
    """HIPRTC compiles it; on Debian 12: `apt-get install libamdhip64-5 libhiprtc-builtins5 rocm-device-libs`."""
    try:
        code = find_compiler(HIP).compile(program(), arch)
    except MissingDependency as error:
        pytest.skip(str(error))
    assert code.startswith(b"\x7fELF")
    for name in kernels(program()):
        assert f"{name}.kd\0".encode() in code, name


def test_a_processor_of_the_future_gets_what_its_driver_translates() -> None:
    newest = nvrtc().newest("sm_999")
    assert nvrtc().newest("sm_90") == "sm_90"
    assert newest.startswith("compute_")
    assert b".target sm_" in nvrtc().compile(program(), newest)


@pytest.mark.parametrize("way", [nvrtc, cuda_core])
def test_a_text_that_does_not_compile_is_told_with_its_line(way: Callable[[], Compiler | CudaCore]) -> None:
    broken = program().replace("store3(a.colors, at,", "store4(a.colors, at,")
    with pytest.raises(MissingDependency, match=r'blend\.h\(\d+\): error: identifier "store4" is undefined'):
        way().compile(broken, "sm_90")


def test_cuda_core_is_the_second_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """No library lies beside torch, nor where the system looks for one."""
    nvrtc()
    monkeypatch.setattr(compiler, "installed", lambda dialect: [])
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    found = find_compiler(CUDA, cuda_core().version.partition(".")[0])
    assert isinstance(found, CudaCore)
    assert found.compile(program(), "sm_90") == nvrtc().compile(program(), "sm_90")
    assert (found.newest("sm_90"), found.newest("sm_999")) == ("sm_90", nvrtc().newest("sm_999"))
    assert found.path.startswith("cuda-core 1.")
    with pytest.raises(MissingDependency, match="needs the library nvrtc 12"):
        find_compiler(CUDA, "12")


@pytest.mark.parametrize(
    ("dialect", "major", "line"),
    [
        (CUDA, "12", "pip install nvidia-cuda-nvrtc-cu12"),
        (CUDA, "13", "pip install nvidia-cuda-nvrtc$"),
        (HIP, None, "torch for ROCm"),
    ],
)
def test_a_missing_library_is_named_with_what_installs_it(
    dialect: compiler.Dialect, major: str | None, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.path", [])
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setattr(compiler, "CudaCore", no_package)
    with pytest.raises(MissingDependency, match=line):
        find_compiler(dialect, major)


def test_only_the_version_that_torch_was_built_for_is_taken() -> None:
    assert compiler._is_version("libnvrtc.so.13", "13")
    assert not compiler._is_version("libnvrtc.so.12", "13")
    assert compiler._is_version("nvrtc64_120_0.dll", "12")
    assert not compiler._is_version("nvrtc64_130_0.dll", "12")


def test_nothing_is_loaded_from_the_folder_one_works_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "libnvrtc-builtins.so.13.0").write_bytes(b"a stranger's")
    monkeypatch.chdir(tmp_path)
    assert builtins_beside(Path("libnvrtc.so")) == []
    assert builtins_beside(tmp_path / "libnvrtc.so") == [tmp_path / "libnvrtc-builtins.so.13.0"]
