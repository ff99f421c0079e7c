"""torch.mps.compile_shader without a Mac: the text compiled by g++ with tests/metal/run, where threads take turns.

A kernel takes what torch's takes (torch/csrc/mps/Module.cpp): tensors, and lists of whole numbers as int64; `threads`
counts all threads. It refuses what Metal refuses: more than 31 buffers, blocks that are too large, text beyond ASCII.
"""

from __future__ import annotations

import ctypes
import functools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from pretend_gpu import APPLE, pretend_gpu
from simt_runtime import Order, simt_backend
from torch import Tensor

from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.device.mps import MpsRuntime

METAL = Path(__file__).with_name("metal")
HEAD = re.compile(r"kernel void (\w+)\((.*?)\) \{")
SHARED = "#define SHARED threadgroup\n"
BLOCK_BYTES = 32 * 1024


class FakeKernel:
    """One kernel of a library."""

    max_threads_per_threadgroup = 1024

    def __init__(self, library: FakeLibrary, name: str, buffers: int) -> None:
        self._library, self._name, self._buffers = library, name, buffers

    def __call__(self, *args: Any, threads: int, group_size: int) -> None:
        """Runs to its end."""
        if len(args) != self._buffers:
            raise RuntimeError(f"{self._name} wants {self._buffers} buffers, got {len(args)}")
        if group_size > self.max_threads_per_threadgroup or threads % group_size:
            raise RuntimeError(f"{threads} threads in groups of {group_size}")
        self._library.launched.append(self._name)
        keep = [_bound(arg) for arg in args]
        addresses = (ctypes.c_void_p * len(args))(*(address for address, _ in keep))
        self._library.run(self._name, addresses, threads // group_size)


def _bound(arg: Any) -> tuple[int, Any]:
    """The address of an argument, and what must live until it is read."""
    if isinstance(arg, Tensor):
        assert arg.numel() > 0, "an empty tensor has no buffer"
        assert arg.is_contiguous()
        return arg.data_ptr(), arg
    assert isinstance(arg, list)
    assert all(type(number) is int and -(2**63) <= number < 2**63 for number in arg)
    array = (ctypes.c_int64 * len(arg))(*arg)
    return ctypes.addressof(array), array


class FakeLibrary:
    """The library of kernels that compile_shader returns."""

    def __init__(self, source: str, order: Order) -> None:
        self.launched: list[str] = []
        self._order = order
        self._built = compiled(source)
        self._buffers = {name: head.count("[[buffer(") for name, head in HEAD.findall(source)}

    def __getattr__(self, name: str) -> FakeKernel:
        if name not in self._buffers:
            raise RuntimeError(f"Failed to create function state object for: {name}")
        return FakeKernel(self, name, self._buffers[name])

    def run(self, name: str, buffers: Any, blocks: int) -> None:
        """Run every block."""
        getattr(self._built, f"run_{name}")(buffers, ctypes.c_int32(blocks), ctypes.byref(self._order))


@functools.cache
def compiled(source: str) -> ctypes.CDLL:
    """The text as a library of this processor. Raises SyntaxError, as torch does."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    source.encode("ascii")
    assert SHARED in source
    entries = [_entry(name, head.count("[[buffer(")) for name, head in HEAD.findall(source)]
    text = source.replace(SHARED, "#define SHARED static\n") + "".join(entries)
    with tempfile.TemporaryDirectory() as folder:
        file, built = Path(folder, "kernels.cpp"), Path(folder, "kernels.so")
        file.write_text(text, encoding="ascii")
        flags = ["-std=c++17", "-O1", "-fPIC", "-shared", "-Wno-attributes", "-ftrivial-auto-var-init=pattern"]
        flags += ["-fsanitize=undefined", "-fno-sanitize-recover=undefined", f"-I{METAL / 'run'}"]
        done = subprocess.run([compiler, *flags, "-Wall", "-Wextra", "-Werror", file, "-o", built], capture_output=True)
        if done.returncode:
            raise SyntaxError(done.stderr.decode())
        return ctypes.CDLL(str(built))


def _entry(name: str, buffers: int) -> str:
    """Runs the blocks of one kernel."""
    assert buffers <= 31
    arguments = ", ".join(f"Buffer{{buffers[{k}]}}" for k in range(buffers))
    return (
        f'extern "C" void run_{name}(void** buffers, int blocks, const metal::Order* order) {{\n'
        "  for (int k = 0; k < blocks; ++k) {\n"
        "    const uint block = order->backwards ? blocks - 1 - k : k;\n"
        f"    metal::block_here.run([&](uint t) {{ {name}({arguments}, block, t); }}, *order);\n"
        "  }\n}\n"
    )


def metal_backend(lockstep: int = 32, backwards: bool = False) -> DeviceBackend:
    """The backend of Apple's GPU, for tensors of this CPU."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.mps, "compile_shader", lambda source: FakeLibrary(source, Order.of(lockstep, backwards)))
        return DeviceBackend(MpsRuntime(torch.device("cpu")))


KERNEL_TEXTS = {"simt": simt_backend, "metal": metal_backend}
"""The backends of GPUs, run on this CPU."""


@contextmanager
def fake_mps(lockstep: int = 32, backwards: bool = False) -> Iterator[list[FakeLibrary]]:
    """A Mac's GPU, as torch shows it, and the libraries that were compiled for it."""
    libraries: list[FakeLibrary] = []

    def compile_shader(source: str) -> FakeLibrary:
        libraries.append(FakeLibrary(source, Order.of(lockstep, backwards)))
        return libraries[-1]

    with pytest.MonkeyPatch.context() as patch, pretend_gpu(APPLE):
        patch.setattr("torch.backends.mps.is_built", lambda: True)
        patch.setattr("torch.backends.mps.is_available", lambda: True)
        patch.setattr(torch.mps, "compile_shader", compile_shader)
        patch.setattr(torch.mps, "recommended_max_memory", lambda: 10**12)
        patch.setattr(torch.mps, "driver_allocated_memory", lambda: 0)
        yield libraries
