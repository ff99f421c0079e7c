"""The second way to NVRTC: NVIDIA's package cuda-core, which finds it in a CUDA toolkit and in conda's folders too."""

from __future__ import annotations

import importlib
from typing import Any

from gsopt.errors import MissingDependency


class CudaCore:
    """NVRTC, called by cuda-core. Raises ImportError or RuntimeError where either is not there."""

    def __init__(self) -> None:
        self._core = importlib.import_module("cuda.core")
        self._nvrtc = importlib.import_module("cuda.bindings.nvrtc")
        _, major, minor = self._nvrtc.nvrtcVersion()
        self.version = f"{major}.{minor}"
        self.path = f"cuda-core {self._core.__version__}, nvrtc"

    def compile(self, text: str, arch: str) -> bytes:
        """See `Compiler.compile`."""
        options = self._core.ProgramOptions(
            name="gsopt-kernels.cu", std="c++17", arch=arch, device_as_default_execution_space=True
        )
        try:
            kind = "ptx" if arch.startswith("compute_") else "cubin"
            code: Any = self._core.Program(text, "c++", options=options).compile(kind).code
        except Exception as error:  # its own class differs from version to version
            raise MissingDependency(
                f"{self.path} {self.version} cannot compile gsopt's kernels for {arch}: {error}. Install the version "
                "that belongs to your torch, or use --backend cpu."
            ) from error
        return bytes(code)

    def newest(self, arch: str) -> str:
        """See `Compiler.newest`."""
        _, known = self._nvrtc.nvrtcGetSupportedArchs()
        return arch if int(arch.removeprefix("sm_")) in known else f"compute_{max(known)}"
