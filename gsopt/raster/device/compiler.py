"""Run-time compilation of the kernels: NVRTC, or HIPRTC on AMD, called by ctypes. Neither needs a GPU or a driver.

Builds of torch for a GPU bring the library along; `nvidia-cuda-nvrtc` of PyPI is the same.
"""

from __future__ import annotations

import contextlib
import ctypes
import ctypes.util
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from gsopt.errors import MissingDependency
from gsopt.raster.device.cuda_core import CudaCore

OPTIONS = ("--std=c++17",)


@dataclass(frozen=True)
class Dialect:
    """The differences between the two libraries."""

    prefix: str
    """First part of their functions' names."""
    code: str
    """The function that hands out machine code."""
    arch: str
    """The option that names the processor."""
    options: tuple[str, ...]
    files: tuple[str, ...]
    """Patterns of the library's file name, on Linux and on Windows."""
    folders: tuple[str, ...]
    """Places under a folder of installed packages."""
    system: tuple[str, ...]
    """Names under which the system may have it."""


CUDA = Dialect(
    "nvrtc",
    "CUBIN",
    "--gpu-architecture=",
    ("--device-as-default-execution-space",),
    ("libnvrtc.so.*", "nvrtc64_*.dll"),
    ("nvidia/cu13/lib", "nvidia/cuda_nvrtc/lib", "nvidia/cu13/bin/x86_64", "nvidia/cuda_nvrtc/bin", "torch/lib"),
    ("nvrtc",),
)
HIP = Dialect(
    "hiprtc",
    "Code",
    "--offload-arch=",
    (),
    ("libhiprtc.so*", "hiprtc*.dll"),
    ("torch/lib",),
    ("hiprtc", "amdhip64"),  # older ones are a part of the driver
)


class Compiler:
    """One such library."""

    def __init__(self, path: Path | str, dialect: Dialect = CUDA) -> None:
        self.path = str(path)
        self._dialect = dialect
        self._builtins = [ctypes.CDLL(str(file)) for file in builtins_beside(Path(path))]
        self._library = ctypes.CDLL(self.path)

    @property
    def version(self) -> str:
        """The library's version, as `13.5`."""
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._call("Version", ctypes.byref(major), ctypes.byref(minor))
        return f"{major.value}.{minor.value}"

    def compile(self, text: str, arch: str) -> bytes:
        """Machine code of the text for one processor (`sm_90`), or for a `compute_90` what a driver makes it of."""
        program = ctypes.c_void_p()
        self._call("CreateProgram", ctypes.byref(program), text.encode(), b"gsopt-kernels.cu", 0, None, None)
        try:
            options = [f"{self._dialect.arch}{arch}", *OPTIONS, *self._dialect.options]
            array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
            if self._function("CompileProgram")(program, len(options), array):
                log = self._output(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
                raise MissingDependency(
                    f"{self.path} {self.version} cannot compile gsopt's kernels for {arch}: {log}. Install the version "
                    "that belongs to your torch, or use --backend cpu."
                )
            return self._output(program, "PTX" if arch.startswith("compute_") else self._dialect.code)
        finally:
            self._function("DestroyProgram")(ctypes.byref(program))

    def newest(self, arch: str) -> str:
        """`arch` where the library knows it, else the newest that it knows, to be translated by the driver."""
        if self._dialect is not CUDA:
            return arch
        count = ctypes.c_int()
        self._call("GetNumSupportedArchs", ctypes.byref(count))
        known = (ctypes.c_int * count.value)()
        self._call("GetSupportedArchs", known)
        return arch if int(arch.removeprefix("sm_")) in known else f"compute_{max(known)}"

    def _output(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._call(f"Get{what}Size", program, ctypes.byref(size))
        data = ctypes.create_string_buffer(size.value)
        self._call(f"Get{what}", program, data)
        return data.raw

    def _call(self, name: str, *arguments: object) -> None:
        status = self._function(name)(*arguments)
        if status:
            raise MissingDependency(
                f"{self._dialect.prefix}{name} of {self.path} returned {status}. Install the library anew, or use "
                "--backend cpu."
            )

    def _function(self, name: str) -> ctypes._NamedFuncPointer:
        return getattr(self._library, f"{self._dialect.prefix}{name}")


def find_compiler(dialect: Dialect = CUDA, major: str | None = None) -> Compiler | CudaCore:
    """The library of version `major` beside torch, else that of the system, else the one that cuda-core finds; any
    version if `major` is absent.

    Raises MissingDependency, with the pip line, where there is none.
    """
    found = [path for path in installed(dialect) if major is None or _is_version(path.name, major)]
    for path in [*map(str, found), *filter(None, map(ctypes.util.find_library, dialect.system))]:
        try:
            return Compiler(path, dialect)
        except OSError:
            continue
    with contextlib.suppress(ImportError, RuntimeError):
        core = CudaCore()
        if dialect is CUDA and (major is None or core.version.partition(".")[0] == major):
            return core
    raise MissingDependency(
        f"The GPU backend needs the library {dialect.prefix}{' ' + major if major else ''}, which builds of torch for "
        f"GPUs bring along and which is not there. {remedy(dialect, major)}"
    )


def remedy(dialect: Dialect, major: str | None) -> str:
    """The pip line that brings the library."""
    if dialect is HIP:
        return "Install torch for ROCm: pip install torch, with the index that torch's start page names for your ROCm."
    name = "nvidia-cuda-nvrtc-cu12" if major == "12" else "nvidia-cuda-nvrtc"
    return f"Install it with: pip install {name}"


def builtins_beside(library: Path) -> list[Path]:
    """Returns what NVRTC before 13.5 opens by name alone; it finds only what is loaded already."""
    if not library.is_absolute():  # a name, not a file of ours: nothing of the folder one works in is loaded
        return []
    return [file for file in sorted(library.parent.glob("*nvrtc-builtins*")) if ".alt." not in file.name]


def installed(dialect: Dialect) -> list[Path]:
    """Such libraries in the folders of installed packages, in the order in which Python looks through them."""
    folders = [Path(entry, folder) for entry in sys.path if entry for folder in dialect.folders]
    paths = [path for folder in folders for pattern in dialect.files for path in sorted(folder.glob(pattern))]
    return [path for path in paths if "builtins" not in path.name and ".alt." not in path.name]


def _is_version(name: str, major: str) -> bool:
    """`libnvrtc.so.13` and `nvrtc64_130_0.dll` are of version 13."""
    match = re.search(r"\.so\.(\d+)|64_(\d+)\d_", name)
    return match is None or major in match.groups()
