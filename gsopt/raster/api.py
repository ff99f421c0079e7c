"""`rasterize`: Gaussians and cameras in, differentiable images out; and the choice of a backend."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt import check
from gsopt.errors import InputError, MissingDependency, UsageError
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.autograd import draw
from gsopt.raster.backend import Backend, RasterSettings, enough_memory

BACKENDS = ("auto", "cpu", "cuda", "mps", "reference")
GPUS = ("cuda", "mps")
DEVICES = ("cpu", *GPUS)
FLOAT32_MAX = torch.finfo(torch.float32).max
MAX_SIDE = 1 << 24
"""Width and height of an image, px: beyond, float32 misses pixels."""
DEFAULT_SETTINGS = RasterSettings()


@dataclass(frozen=True)
class Rendering:
    """The images of C cameras."""

    colors: Float[Tensor, "C H W 3"]
    """On the background that was given, else premultiplied."""
    alphas: Float[Tensor, "C H W 1"]
    depths: Float[Tensor, "C H W 1"] | None
    """Expected depth along the viewing axis, scene units, 0 where nothing was hit, or None unless requested."""
    radii: Int[Tensor, "C N 2"]
    """Half-extent of each splat in px; 0 where it is not in the image."""


def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RasterSettings = DEFAULT_SETTINGS,
    background: Float[Tensor, "3"] | None = None,
    backend: Backend | str = "auto",
    threads: int = 0,
    depth: bool = False,
) -> Rendering:
    """Draw every camera. Differentiable, once, in the six parameters and the background (not in the cameras).

    `backend` is a Backend or a name that `make_backend` knows; `threads` is heeded for a name only (0 = one per core).
    Raises InputError for tensors of wrong shape, dtype or value, NumericalError for an image that memory cannot hold,
    MissingDependency when the backend is not built.
    """
    _validate_types(gaussians, cameras, settings, background)
    _validate(gaussians, cameras, background)
    engine = backend if hasattr(backend, "forward") else _beside(gaussians, backend, threads)
    assert not isinstance(engine, str)
    with enough_memory(len(gaussians), cameras.width, cameras.height):
        return _stacked(engine, gaussians, cameras, settings, background, depth)


def _stacked(
    engine: Backend,
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RasterSettings,
    background: Float[Tensor, "3"] | None,
    depth: bool,
) -> Rendering:
    images = [draw(engine, gaussians, cameras[c], settings, background, depth) for c in range(len(cameras))]
    colors = torch.stack([colors for colors, _, _, _ in images])
    alphas = torch.stack([alphas for _, alphas, _, _ in images])
    depths = torch.stack([depths for _, _, depths, _ in images if depths is not None]) if depth else None
    return Rendering(
        colors=colors,
        alphas=alphas[..., None],
        depths=None if depths is None else expected_depth(depths, alphas)[..., None],
        radii=torch.stack([radii for _, _, _, radii in images]),
    )


def _beside(gaussians: Gaussians, backend: str, threads: int) -> Backend:
    """The backend of that name; "auto" is that of the device where the Gaussians lie."""
    device = gaussians.means.device
    return make_backend(backend, threads, str(device) if device.type in DEVICES else "")


def expected_depth(depths: Float[Tensor, "*C H W"], alphas: Float[Tensor, "*C H W"]) -> Float[Tensor, "*C H W"]:
    """(Σ T alpha z) / alpha; 0 with zero gradient where alpha is 0."""
    hit = alphas > 0
    return torch.where(hit, depths / torch.where(hit, alphas, 1), 0)


def make_backend(name: str = "auto", threads: int = 0, device: str = "") -> Backend:
    """The backend of that name. "auto": "cuda" or "mps" where torch finds a GPU, else "cpu", never the slow reference.

    `device`: "cpu", "cuda", "mps" or a certain GPU, as "cuda:1"; it decides for "auto". Raises UsageError for a name
    that none has, MissingDependency, with what to install, for a GPU that cannot be used and an extension not built.
    """
    check.instance("backend", name, str)
    check.one_of("backend", name, BACKENDS)
    check.instance("threads", threads, int)
    check.at_least("threads", threads, 0, "0 takes one thread per core.")
    check.within("threads", threads, 0, check.MAX_THREADS, "0 takes one thread per core.")
    if gpu := _gpu_of(name, check.device(device)):
        from gsopt.raster.device.gpus import open_gpu

        return open_gpu(gpu, device)
    if name == "reference":
        from gsopt.raster.reference import ReferenceBackend

        return ReferenceBackend()
    try:
        module = importlib.import_module("gsopt.raster.cpu_backend")
    except ImportError as error:
        raise MissingDependency(
            f"The backend {name!r} needs gsopt's compiled rasterizer, which is not built ({error}). "
            "Build it in the source folder with: pip install -e ."
        ) from error
    backend: Backend = module.CpuBackend(threads)
    return backend


def _gpu_of(backend: str, device: str) -> str:
    """The kind of GPU that a backend and a kind of device ask for, or nothing."""
    if backend in GPUS:
        if device not in ("", backend):
            raise UsageError(f"`device` is {device}, but `backend` is {backend}. Leave one of them out.")
        return backend
    if backend != "auto" or device == "cpu":
        return ""
    from gsopt.raster.device.gpus import seen

    return device or seen()


def _validate_types(gaussians: object, cameras: object, settings: object, background: object) -> None:
    for name, value, kind in (
        ("gaussians", gaussians, Gaussians),
        ("cameras", cameras, Cameras),
        ("settings", settings, RasterSettings),
    ):
        check.instance(name, value, kind)
    assert isinstance(gaussians, Gaussians)
    assert isinstance(cameras, Cameras)
    tensors = [*gaussians.items(), ("viewmats", cameras.viewmats), ("Ks", cameras.Ks), ("background", background)]
    for tensor_name, tensor in tensors:
        if tensor_name != "background" or tensor is not None:
            check.dense(tensor_name, tensor)
    for side, pixels in (("width", cameras.width), ("height", cameras.height)):
        check.instance(side, pixels, int)
        check.at_least(side, pixels, 1, "Give the image size in pixels.")
        check.within(side, pixels, 1, MAX_SIDE, "Give the image size in pixels.")


def _validate(gaussians: Gaussians, cameras: Cameras, background: Tensor | None) -> None:
    gaussians.validate()
    cameras.validate()
    if len(cameras) == 0:
        raise InputError("`cameras` must hold at least one camera, got 0. Give viewmats of shape [C, 4, 4], C >= 1.")
    wanted = gaussians.means.dtype, gaussians.means.device
    for name, tensor in gaussians.items():
        if tensor.dtype not in (torch.float32, torch.float64) or (tensor.dtype, tensor.device) != wanted:
            raise InputError(
                f"`{name}` must be float32 or float64 like `means` and beside it ({wanted[0]} on {wanted[1]}), "
                f"got {tensor.dtype} on {tensor.device}. Convert the record with Gaussians.to()."
            )
    if background is not None:
        check.shape("background", background, (3,))
        check.finite("background", background)
    doubles = [*gaussians.items(), ("viewmats", cameras.viewmats), ("Ks", cameras.Ks), ("background", background)]
    for name, value in doubles:
        if value is not None and value.dtype == torch.float64:  # kernels read it as float32, where 1e39 is infinite
            check.finite(name, value, FLOAT32_MAX)
