"""The GPU that torch sees: its kernels compiled, or read from the cache, loaded, and started on torch's stream."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from gsopt.errors import MissingDependency, UsageError
from gsopt.raster.device import cache
from gsopt.raster.device.compiler import CUDA, HIP, Compiler, find_compiler
from gsopt.raster.device.cuda_core import CudaCore
from gsopt.raster.device.driver import CUDA_DRIVER, HIP_DRIVER, Driver, open_driver
from gsopt.raster.device.layout import filled, kernels
from gsopt.raster.device.source import program

INSTALL = "pip install torch, with the index that torch's start page names for your CUDA"


@dataclass(frozen=True)
class Tools:
    """A compiler and a driver that belong together."""

    compiler: Compiler | CudaCore
    driver: Driver

    @staticmethod
    def of_torch() -> Tools:
        """Those of the platform that torch was built for."""
        if torch.version.hip:
            return Tools(find_compiler(HIP), open_driver(HIP_DRIVER))
        major = str(torch.version.cuda).partition(".")[0]
        return Tools(find_compiler(CUDA, major), open_driver(CUDA_DRIVER))


class GpuRuntime:
    """Kernels on one GPU."""

    name = "cuda"

    def __init__(self, device: torch.device, tools: Tools) -> None:
        self.device = device
        self._driver = tools.driver
        began = time.perf_counter()
        arch = processor(device)
        target = tools.compiler.newest(arch)
        text = program()
        self._records = kernels(text)
        key = f"{text} {target} {tools.compiler.version} {tools.compiler.path}"
        code = cache.cached(key, lambda: tools.compiler.compile(text, target))
        with torch.cuda.device(device):
            torch.empty(1, device=device)  # torch makes its context, and makes it current
            self._functions = tools.driver.load(code, list(self._records))
            self._context = tools.driver.context()
        self.about = {
            "device": f"{torch.cuda.get_device_name(device)} ({device})",
            "arch": arch,
            "library": f"{tools.compiler.path} {tools.compiler.version}, driver for CUDA {tools.driver.version()}",
            "compile_seconds": f"{time.perf_counter() - began:.2f}",
        }

    def launch(self, kernel: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """See `Runtime.launch`."""
        with torch.cuda.device(self.device):
            stream = torch.cuda.current_stream(self.device).cuda_stream
            record = filled(self._records[kernel], arguments)
            self._driver.launch(self._functions[kernel], blocks, stream, record, self._context)


def processor(device: torch.device) -> str:
    """The GPU's architecture as its compiler calls it: `sm_90`, `gfx1100`."""
    if torch.version.hip:
        return str(torch.cuda.get_device_properties(device).gcnArchName).partition(":")[0]
    major, minor = torch.cuda.get_device_capability(device)
    return f"sm_{major}{minor}"


def available() -> bool:
    """True when torch sees a GPU that these kernels can run on."""
    return torch.cuda.is_available() and torch.cuda.device_count() > 0


def chosen_device(name: str = "") -> torch.device:
    """`cuda:1` to a device; empty: torch's current one. Raises UsageError, or MissingDependency with the pip line."""
    if not torch.version.cuda and not torch.version.hip:
        raise MissingDependency(
            f"`backend` is cuda, but this torch ({torch.__version__}) is built for CPUs. Install one for GPUs: "
            f"{INSTALL}. Or use --backend cpu."
        )
    if not available():
        raise MissingDependency(
            f"`backend` is cuda, but torch {torch.__version__} (CUDA {torch.version.cuda}) finds no GPU: none is "
            "there, or its driver is missing or older than that CUDA. Look at `nvidia-smi`, install a newer driver, or "
            "use --backend cpu."
        )
    count = torch.cuda.device_count()
    index = int(name.partition(":")[2] or torch.cuda.current_device())
    if index >= count:
        raise UsageError(f"`device` is {name}, but there are {count} GPUs: cuda:0 to cuda:{count - 1}.")
    return torch.device("cuda", index)


def gpu_runtime(name: str = "") -> GpuRuntime:
    """The kernels on the GPU of that name."""
    return GpuRuntime(chosen_device(name), Tools.of_torch())
