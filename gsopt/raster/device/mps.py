"""Apple's GPU: the kernels compiled by torch.mps.compile_shader, which needs neither Xcode nor a Metal toolchain.

torch binds a tensor as a buffer and a list of whole numbers as bytes of int64 (torch/csrc/mps/Module.cpp); `threads`
counts all threads, `group_size` those of a block.
"""

from __future__ import annotations

import ctypes
import platform
import struct
import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsopt.errors import MissingDependency, UsageError
from gsopt.raster.device.layout import filled, kernels
from gsopt.raster.device.metal import metal_program
from gsopt.raster.device.runtime import THREADS
from gsopt.raster.device.source import program

WORD = 8


class MpsRuntime:
    """Kernels on Apple's GPU."""

    name = "mps"

    def __init__(self, device: torch.device) -> None:
        self.device = device
        began = time.perf_counter()
        self._records = kernels(program())
        self._functions = _compiled(list(self._records))
        self._no_buffer = torch.zeros(1, device=device)
        self.about = {
            "device": f"Apple {platform.machine()} ({device})",
            "arch": "Metal",
            "library": f"torch.mps.compile_shader of torch {torch.__version__}, macOS {platform.mac_ver()[0]}",
            "compile_seconds": f"{time.perf_counter() - began:.2f}",
        }

    def launch(self, kernel: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """See `Runtime.launch`."""
        buffers: list[Tensor] = []

        def pointer(tensor: Tensor | None) -> int:
            """Binds a buffer in any case: Metal wants all that a kernel declares."""
            buffers.append(self._no_buffer if tensor is None or tensor.numel() == 0 else tensor)
            return int(tensor is not None)

        record = filled(self._records[kernel], arguments, pointer)
        self._functions[kernel](whole_numbers(record), *buffers, threads=blocks * THREADS, group_size=THREADS)


def whole_numbers(record: ctypes.Structure) -> list[int]:
    """The bytes of a record as int64, filled up with zeros."""
    words = -(-ctypes.sizeof(record) // WORD)
    return list(struct.unpack(f"{words}q", bytes(record).ljust(words * WORD, b"\0")))


def _compiled(names: list[str]) -> dict[str, Any]:
    """The kernels of these names. Raises MissingDependency with the compiler's words."""
    try:
        library = torch.mps.compile_shader(metal_program())
        functions = {name: getattr(library, name) for name in names}
    except (SyntaxError, RuntimeError) as error:
        raise MissingDependency(
            f"torch {torch.__version__} cannot compile gsopt's kernels for Apple's GPU: {error}. Install a newer torch "
            "and macOS, or use --backend cpu."
        ) from error
    for name, function in functions.items():
        if function.max_threads_per_threadgroup < THREADS:
            raise MissingDependency(
                f"Apple's GPU runs at most {function.max_threads_per_threadgroup} threads of the kernel `{name}` "
                f"together, which needs {THREADS}. Use --backend cpu."
            )
    return functions


def available() -> bool:
    """True when torch sees a GPU of Apple."""
    return torch.backends.mps.is_available()


def mps_runtime(name: str = "") -> MpsRuntime:
    """The kernels on the GPU of that name. Raises MissingDependency where there is none."""
    if not torch.backends.mps.is_built():
        raise MissingDependency(
            f"`backend` is mps, but this torch ({torch.__version__}) is not built for Apple's GPUs. On a Mac with "
            "Apple silicon, `pip install torch` brings one that is; elsewhere use --backend cpu."
        )
    if not available():
        raise MissingDependency(
            f"`backend` is mps, but torch {torch.__version__} finds no GPU of Apple: it wants Apple silicon and "
            "macOS 14 or newer. Use --backend cpu."
        )
    if name not in ("", "mps", "mps:0"):
        raise UsageError(f"`device` is {name}, but the backend mps has one GPU, mps:0. Leave it out.")
    return MpsRuntime(torch.device("mps", 0))
