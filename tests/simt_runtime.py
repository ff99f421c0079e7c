"""The kernels of a GPU on a CPU: their text compiled by g++ behind simt.h, a block at a time, a thread at a time."""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.device.layout import filled, kernels
from gsopt.raster.device.runtime import THREADS
from gsopt.raster.device.source import program

SIMT = Path(__file__).with_name("simt.h")
# Without the address sanitizer: it wants to be loaded before Python; `make sanitize` adds it.
FLAGS = os.environ.get("GSOPT_SIMT_FLAGS", "-fsanitize=undefined -fno-sanitize-recover=undefined").split()


def compiler() -> str:
    """The path of the C++ compiler; a test that needs one is skipped where there is none."""
    found = shutil.which(os.environ.get("CXX", "g++"))
    if found is None:
        pytest.skip("no C++ compiler")
    return found


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled kernels; every number that a kernel forgot to write is a pattern of bits."""
    cxx = compiler()
    with tempfile.TemporaryDirectory() as folder:
        source, built = Path(folder, "kernels.cpp"), Path(folder, "kernels.so")
        source.write_text(program(SIMT), encoding="utf-8")
        flags = ["-std=c++20", "-O1", "-g1", "-fPIC", "-shared", "-ftrivial-auto-var-init=pattern", *FLAGS]
        alone = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
        done = subprocess.run(
            [cxx, *flags, "-Wall", "-Wextra", "-Werror", source, "-o", built], capture_output=True, env=alone
        )
        assert done.returncode == 0, done.stderr.decode()
        return ctypes.CDLL(str(built))


class Order(ctypes.Structure):
    """`Order` of simt.h."""

    _fields_ = (("threads", ctypes.c_int32 * (THREADS + 1)), ("backwards", ctypes.c_int32))

    @staticmethod
    def of(lockstep: int, backwards: bool) -> Order:
        """As processors that march `lockstep` threads at once take them: number k of every group, then number k + 1."""
        threads = [group * lockstep + k for k in range(lockstep) for group in range(THREADS // lockstep)]
        if backwards:
            threads.reverse()
        return Order((ctypes.c_int32 * (THREADS + 1))(*threads), backwards)


class SimtRuntime:
    """Runs the kernels in this process."""

    name = "simt"

    def __init__(self, lockstep: int = 32, backwards: bool = False, device: str = "cpu") -> None:
        """`device`: where the tensors say that they lie (pretend_gpu.py)."""
        self.device = torch.device(device)
        self.about = {"lockstep": str(lockstep)}
        self._order = Order.of(lockstep, backwards)
        self._library = library()

    def launch(self, kernel: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """Run a kernel to its end."""
        self.run(kernel, blocks, filled(kernels(program())[kernel], arguments))

    def run(self, kernel: str, blocks: int, record: ctypes.Structure) -> None:
        """The same with a record of addresses."""
        run = getattr(self._library, f"run_{kernel}")
        run(ctypes.byref(record), ctypes.c_int32(blocks), ctypes.byref(self._order))

    def size_of(self, kernel: str) -> int:
        """Bytes of the kernel's record, as its compiler has it."""
        measure = getattr(self._library, f"size_of_{kernel}")
        measure.restype = ctypes.c_ulong
        return int(measure())


def simt_backend(lockstep: int = 32, backwards: bool = False) -> DeviceBackend:
    """The GPU backend on a CPU."""
    return DeviceBackend(SimtRuntime(lockstep, backwards))
