"""A GPU draws a tiny scene and steps it before it is trusted: its result must be that of the float64 reference.

A compiler or a driver that goes wrong would otherwise show as a picture that never gets sharp. The tolerance is wide:
tests measure how exact the kernels are (tests/raster/tolerances.py), and what goes wrong is wrong by far.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gsopt.errors import NumericalError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.backend import AdamStep, Backend, RasterSettings
from gsopt.raster.reference import ReferenceBackend

COUNT = 100
WIDTH, HEIGHT = 37, 21
"""px; not whole tiles."""
TOLERANCE = 1e-2


def require_right(backend: Backend) -> None:
    """Raises NumericalError for a backend that draws or steps the scene in another way than the reference."""
    wanted, got = _reference(), _results(backend, torch.float32)
    wrong = {name: error for name in wanted if not (error := _relative(got[name], wanted[name])) <= TOLERANCE}
    if wrong:
        told = ", ".join(f"{name} by {error:.2g}" for name, error in wrong.items())
        raise NumericalError(
            f"The GPU {backend.device} computes a test image wrong ({told}, relative). Its driver or its compiler may "
            "be at fault: update it, and torch. Use --backend cpu until `gsopt doctor` finds nothing wrong."
        )


@functools.cache
def _reference() -> dict[str, Tensor]:
    return _results(ReferenceBackend(), torch.float64)


def _results(backend: Backend, dtype: torch.dtype) -> dict[str, Tensor]:
    """An image, its loss, the gradients and the parameters after a step."""
    scene, camera, settings = _scene().to(dtype).to(backend.device), _camera(), RasterSettings()
    frame = backend.forward(scene, camera, settings, torch.full((3,), 0.5, dtype=dtype), depth=True)
    target = torch.linspace(0, 1, HEIGHT * WIDTH * 3).view(HEIGHT, WIDTH, 3).to(dtype).to(backend.device)
    loss = backend.photometric(frame.colors, target, 0.2)
    gradients = backend.backward(frame, loss.v_colors)
    mean, square = (Gaussians(**{name: torch.zeros_like(tensor) for name, tensor in scene.items()}) for _ in range(2))
    results = {"colors": frame.colors, "depths": frame.depths, "loss": torch.tensor([loss.l1, loss.ssim])}
    results |= {f"v_{name}": getattr(gradients, name) for name in PARAMETERS}
    step = AdamStep(dict.fromkeys(PARAMETERS, 1e-2), dict.fromkeys(PARAMETERS, 1), 0.9, 0.999, 1e-3)
    backend.adam(scene, gradients, mean, square, step, camera, settings)
    results |= {name: tensor for name, tensor in scene.items()}
    return {name: tensor.cpu().double() for name, tensor in results.items() if tensor is not None}


def _relative(got: Tensor, wanted: Tensor) -> float:
    return float((got - wanted).norm() / wanted.norm())


def _scene() -> Gaussians:
    random = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(COUNT, *shape, generator=random)

    return Gaussians(
        means=0.4 * normal(3),
        quats=normal(4),
        log_scales=0.3 * normal(3) - 2.5,
        logit_opacities=normal(),
        sh0=normal(1, 3),
        shN=0.1 * normal(15, 3),
    )


def _camera() -> Cameras:
    viewmats = look_at(torch.tensor([[0.0, -4.0, 1.0]]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Cameras(viewmats, intrinsics(0.7, WIDTH, HEIGHT)[None].float(), WIDTH, HEIGHT)
