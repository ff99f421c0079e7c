"""The GPU that a run takes: one of NVIDIA or AMD (`cuda`), or Apple's (`mps`)."""

from __future__ import annotations

from gsopt.raster.device import gpu, mps
from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.device.runtime import Runtime
from gsopt.raster.device.self_check import require_right


def seen() -> str:
    """The kind of GPU that torch finds, or nothing."""
    if gpu.available():
        return "cuda"
    return "mps" if mps.available() else ""


def open_runtime(kind: str, device: str = "") -> Runtime:
    """The runtime of a GPU of that kind. Raises MissingDependency, with what to do, where nothing does."""
    return mps.mps_runtime(device) if kind == "mps" else gpu.gpu_runtime(device)


def open_gpu(kind: str, device: str = "") -> DeviceBackend:
    """The backend of that kind, once it has drawn a test image right."""
    backend = DeviceBackend(open_runtime(kind, device))
    require_right(backend)
    return backend
