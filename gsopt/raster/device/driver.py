"""The part of a GPU's driver that loads and starts kernels: CUDA's, or HIP's, called by ctypes."""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass

from gsopt.errors import MissingDependency, NumericalError
from gsopt.raster.device.runtime import THREADS

OUT_OF_MEMORY = 2
"""CUDA_ERROR_OUT_OF_MEMORY and hipErrorOutOfMemory."""


@dataclass(frozen=True)
class DriverDialect:
    """The differences between the two drivers."""

    files: tuple[str, ...]
    """Names of the library, on Linux and on Windows."""
    prefix: str
    launch: str
    has_contexts: bool
    """True where a thread must have a context of its own choice to start a kernel."""


CUDA_DRIVER = DriverDialect(
    ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so"), "cu", "cuLaunchKernel", True
)
HIP_DRIVER = DriverDialect(
    ("amdhip64.dll",) if sys.platform == "win32" else ("libamdhip64.so", "libamdhip64.so.6"),
    "hip",
    "hipModuleLaunchKernel",
    False,
)


class Driver:
    """Loads machine code and starts its kernels in the context that torch made current."""

    def __init__(self, library: ctypes.CDLL, dialect: DriverDialect = CUDA_DRIVER) -> None:
        self._library = library
        self._dialect = dialect
        self._launch = getattr(library, dialect.launch)

    def version(self) -> str:
        """The newest version of CUDA that the driver serves, as `13.0`."""
        number = ctypes.c_int()
        self._check(self._call("DriverGetVersion", ctypes.byref(number)))
        return f"{number.value // 1000}.{number.value % 1000 // 10}"

    def load(self, code: bytes, names: list[str]) -> dict[str, ctypes.c_void_p]:
        """The kernels of these names. Raises MissingDependency where the driver does not take the code."""
        module = ctypes.c_void_p()
        status = self._call("ModuleLoadData", ctypes.byref(module), code)
        if status == OUT_OF_MEMORY:
            self._check(status)
        if status:
            raise MissingDependency(
                f"The GPU's driver (CUDA {self.version()}) refuses gsopt's kernels: {self._told(status)}. "
                "It is older than the CUDA that torch was built for: install a newer driver, or torch for an older "
                "CUDA, or use --backend cpu."
            )
        functions = {name: ctypes.c_void_p() for name in names}
        for name, function in functions.items():
            self._check(self._call("ModuleGetFunction", ctypes.byref(function), module, name.encode()))
        return functions

    def context(self) -> ctypes.c_void_p:
        """This thread's context, which torch made; null where the driver has none."""
        found = ctypes.c_void_p()
        if self._dialect.has_contexts:
            self._check(self._call("CtxGetCurrent", ctypes.byref(found)))
        return found

    def launch(
        self,
        function: ctypes.c_void_p,
        blocks: int,
        stream: int,
        arguments: ctypes.Structure,
        context: ctypes.c_void_p,
    ) -> None:
        """Start a kernel that takes one record; in `context` where the thread has none, as autograd's does not."""
        if context and not self.context():
            self._check(self._call("CtxSetCurrent", context))
        values = (ctypes.c_void_p * 1)(ctypes.addressof(arguments))
        grid = (ctypes.c_uint(blocks), ctypes.c_uint(1), ctypes.c_uint(1))
        block = (ctypes.c_uint(THREADS), ctypes.c_uint(1), ctypes.c_uint(1))
        self._check(self._launch(function, *grid, *block, ctypes.c_uint(0), ctypes.c_void_p(stream), values, None))

    def _call(self, name: str, *arguments: object) -> int:
        return int(getattr(self._library, f"{self._dialect.prefix}{name}")(*arguments))

    def _check(self, status: int) -> None:
        if status:
            raise NumericalError(
                f"The GPU failed: {self._told(status)}. The last checkpoint is good: go on with --resume, or with "
                "--resume --backend cpu."
            )

    def _told(self, status: int) -> str:
        """The driver's words for an error."""
        if self._dialect is HIP_DRIVER:
            self._library.hipGetErrorString.restype = ctypes.c_char_p
            return f"{(self._library.hipGetErrorString(status) or b'').decode(errors='replace')} ({status})"
        text = ctypes.c_char_p()
        self._call("GetErrorString", status, ctypes.byref(text))
        return f"{(text.value or b'unknown error').decode(errors='replace')} ({status})"


def open_driver(dialect: DriverDialect = CUDA_DRIVER) -> Driver:
    """The driver of this machine. Raises MissingDependency where there is none."""
    for name in dialect.files:
        try:
            return Driver(ctypes.CDLL(name), dialect)
        except OSError:
            continue
    raise MissingDependency(
        f"The GPU's driver ({dialect.files[0]}) is not there. Install the driver of your GPU's maker, or use "
        "--backend cpu."
    )
