"""Time against error: every backend and instruction set on one scene that the float64 reference can draw."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from gsopt.benchmark.stopwatch import repeat, spread
from gsopt.benchmark.surface_scene import surface_scene
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import make_backend
from gsopt.raster.backend import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Backend, Gradients, RasterSettings
from gsopt.raster.cpu_backend import ISA_VARIABLE
from gsopt.raster.reference import hard_threshold, raw_alphas, splat, transmittances

IMAGE_SIDE, GAUSSIAN_COUNT = 64, 2_000
TIE_MARGIN = 1e-4
"""Relative distance to the threshold at 1/255, the clamp at 0.99 or the stop at T = 1e-4 below which a pixel is left
out: float32 may decide differently there, whatever the quality of its arithmetic."""


def accuracy(count: int = GAUSSIAN_COUNT, side: int = IMAGE_SIDE, repetitions: int = 3) -> dict[str, Any]:
    """Time of forward + backward and error of every backend (`schema.ACCURACY`), the float64 reference first."""
    gaussians, camera = surface_scene(count, side, side)
    exact = gaussians.to(torch.float64)
    decided = decided_pixels(exact, camera)
    weights = torch.randn(side, side, 3, generator=torch.Generator().manual_seed(2)) * decided[..., None]
    reference = make_backend("reference")
    truth, true_gradients = rendered(reference, exact, camera, weights)

    def row(name: str, backend: Backend, model: Gaussians, times: int) -> dict[str, Any]:
        colors, gradients = rendered(backend, model, camera, weights)
        readings = repeat(lambda: rendered(backend, model, camera, weights), times, warm_up=1)
        return {
            "backend": name,
            "ms": spread([reading.cpu for reading in readings]),
            "image_max_error": float((colors - truth)[decided].abs().max()),
            "gradient_error": max(relative_error(gradients, true_gradients, name) for name in PARAMETERS),
        }

    rows = [row("reference64", reference, exact, repetitions), row("reference32", reference, gaussians, repetitions)]
    rows += [row(f"cpu {isa}", backend, gaussians, 10 * repetitions) for isa, backend in compiled()]
    left_out = 100 * (1 - float(decided.double().mean()))
    scene = f"{side}x{side} pixels ({left_out:.1f} % left out), {count:,} Gaussians, forward + backward, 1 thread"
    return {"scene": scene, "rows": rows}


def decided_pixels(gaussians: Gaussians, camera: Cameras) -> Bool[Tensor, "H W"]:
    """True where every decision of the image model is at least `TIE_MARGIN` from changing."""
    nothing = gaussians.means.new_zeros(len(gaussians), 2)
    splats = splat(gaussians, camera.to(gaussians.means.dtype), RasterSettings(), nothing)
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    deltas = torch.stack([x, y], dim=-1).view(-1, 1, 2) - splats.means2d
    raw = raw_alphas(deltas, splats.conics, splats.opacities)
    before, _ = transmittances(hard_threshold(raw))
    lines = [
        (raw, ALPHA_MIN, TIE_MARGIN),
        (raw, ALPHA_MAX, TIE_MARGIN),
        (before, TRANSMITTANCE_MIN, 10 * TIE_MARGIN),
    ]
    ties = [((values / line - 1).abs() < margin).any(dim=1) for values, line, margin in lines]
    return ~torch.stack(ties).any(dim=0).view(camera.height, camera.width)


def compiled() -> Iterator[tuple[str, Backend]]:
    """The compiled backend on every instruction set of this processor."""
    from gsopt.raster import _cpu  # type: ignore[attr-defined]

    for isa in _cpu.instruction_sets():
        with instruction_set(isa):
            backend = make_backend("cpu", 1)
        yield isa, backend


@contextmanager
def instruction_set(isa: str) -> Iterator[None]:
    """Makes backends created in this block run on `isa`."""
    before = os.environ.get(ISA_VARIABLE)
    os.environ[ISA_VARIABLE] = isa
    try:
        yield
    finally:
        if before is None:
            del os.environ[ISA_VARIABLE]
        else:
            os.environ[ISA_VARIABLE] = before


def rendered(backend: Backend, gaussians: Gaussians, camera: Cameras, weights: Tensor) -> tuple[Tensor, Gradients]:
    """A render, and the gradients of a fixed weighted sum of its values."""
    frame = backend.forward(gaussians, camera, RasterSettings())
    return frame.colors, backend.backward(frame, weights.to(frame.colors))


def relative_error(got: Gradients, truth: Gradients, name: str) -> float:
    """|difference| / |truth| (L2) of one parameter's gradient."""
    mine, true = getattr(got, name).double(), getattr(truth, name)
    return float(torch.linalg.vector_norm(mine - true) / torch.linalg.vector_norm(true))
