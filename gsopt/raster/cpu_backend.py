"""The CPU backend: C++ kernels behind the Backend protocol. Float32 only; the same bits for any number of threads."""

from __future__ import annotations

import os
import weakref
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.errors import UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.backend import AdamStep, Gradients, Photometric, RasterSettings, RenderedFrame, enough_memory
from gsopt.raster.tensors import as_float32, contiguous, overwritable
from gsopt.raster.threads import available_cores

ISA_VARIABLE = "GSOPT_ISA"
GRADIENTS = tuple(field.name for field in fields(Gradients))


def workspace(threads: int = 0) -> Any:
    """Makes a pool of `threads` (0: one per core) and picks an instruction set, the best one or that which the
    environment variable GSOPT_ISA (avx512, avx2, avx2x2, portable) names; UsageError if this processor lacks it."""
    try:
        return _cpu.Workspace(threads or available_cores(), os.environ.get(ISA_VARIABLE, ""))
    except ValueError as error:
        raise UsageError(f"{ISA_VARIABLE}: {error}.") from error


@dataclass
class _Context:
    frame: Any
    """The kernels' buffers, or None once given back."""
    model: Any
    gaussians: Gaussians

    def take(self) -> Any:
        """The frame, once: a second use would read buffers that belong to another camera by now."""
        if self.frame is None:
            raise UsageError("This frame was used before. Call `forward` again: a frame serves one `backward`.")
        frame, self.frame = self.frame, None
        return frame


class CpuBackend:
    """`threads` as for `workspace`."""

    name = "cpu"
    device = torch.device("cpu")

    def __init__(self, threads: int = 0) -> None:
        self._workspace = workspace(threads)
        self._views = _Views()
        self._idle: list[Any] = []  # frames whose buffers can be used again

    @property
    def isa(self) -> str:
        """Instruction set in use."""
        return self._workspace.isa

    @property
    def threads(self) -> int:
        return self._workspace.threads

    def forward(
        self,
        gaussians: Gaussians,
        camera: Cameras,
        settings: RasterSettings,
        background: Float[Tensor, "3"] | None = None,
        *,
        depth: bool = False,
    ) -> RenderedFrame:
        """See `Backend.forward`."""
        height, width, n = camera.height, camera.width, len(gaussians)
        gaussians = as_float32(gaussians)
        model = _model(gaussians)
        view = self._views.of(camera, settings)
        behind = (0.0, 0.0, 0.0) if background is None else background.tolist()
        degree = min(settings.sh_degree, gaussians.sh_degree)
        with enough_memory(n, width, height):
            colors, alphas = torch.empty(height, width, 3), torch.empty(height, width)
            depths = torch.empty(height, width) if depth else None
            radii = torch.empty(n, 2, dtype=torch.int32)
            image = _cpu.Image(colors, alphas, depths, radii)
            frame = self._idle.pop() if self._idle else _cpu.Frame()
            _cpu.forward(self._workspace, frame, model, view, image, sh_degree=degree, background=behind)
        return RenderedFrame(colors, alphas, depths, radii, _Context(frame, model, gaussians))

    def backward(
        self,
        frame: RenderedFrame,
        v_colors: Float[Tensor, "H W 3"],
        v_alphas: Float[Tensor, "H W"] | None = None,
        v_depths: Float[Tensor, "H W"] | None = None,
        *,
        absgrad: bool = False,
        bands: bool = True,
        into: Gradients | None = None,
    ) -> Gradients:
        """See `Backend.backward`. The frame's buffers are used again by a later `forward`."""
        context = frame.context
        assert isinstance(context, _Context)
        buffers = context.take()
        gradients = overwritable(context.gaussians, absgrad, bands, into)
        out = _gradient(gradients)
        alphas, depths = contiguous(v_alphas), contiguous(v_depths)
        _cpu.backward(self._workspace, buffers, context.model, contiguous(v_colors), alphas, depths, out)
        self._idle.append(buffers)
        return gradients

    def release(self, frame: RenderedFrame) -> None:
        """Give a frame's buffers back when no `backward` will follow."""
        assert isinstance(frame.context, _Context)
        self._idle.append(frame.context.take())

    def photometric(
        self, rendered: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lambda_dssim: float
    ) -> Photometric:
        """See `Backend.photometric`."""
        height, width = rendered.shape[:2]
        v_colors = torch.empty(height, width, 3)
        l1, ssim = _cpu.photometric(
            self._workspace, rendered.contiguous(), target.contiguous(), v_colors, height, width, lambda_dssim
        )
        return Photometric(l1, ssim, (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim), v_colors)

    def adam(
        self,
        gaussians: Gaussians,
        gradients: Gradients,
        exp_avg: Gaussians,
        exp_avg_sq: Gaussians,
        step: AdamStep,
        camera: Cameras,
        settings: RasterSettings,
    ) -> None:
        """See `Backend.adam`. All tensors must be float32 and contiguous."""
        rates = [step.lr.get(name, 0.0) for name in PARAMETERS]
        steps = [step.steps[name] if name in step.lr else 0 for name in PARAMETERS]
        _cpu.adam(
            self._workspace,
            _model(gaussians),
            _gradient(gradients),
            exp_avg=_model(exp_avg),
            exp_avg_sq=_model(exp_avg_sq),
            step=_cpu.AdamStep(lr=rates, steps=steps, beta1=step.beta1, beta2=step.beta2, eps=step.eps),
            camera=self._views.of(camera, settings),
            sh_degree=min(settings.sh_degree, gaussians.sh_degree),
        )


def _model(record: Gaussians) -> Any:
    return _handle(record, _cpu.Model, PARAMETERS)


def _gradient(record: Gradients) -> Any:
    return _handle(record, _cpu.Gradient, GRADIENTS)


_handles: dict[int, tuple[tuple[int, ...], Any]] = {}
"""Views of records that the kernels have seen, by id, as long as these live: making one takes a microsecond or more for
every tensor. And where the tensors' memory lay."""


def _handle(record: Any, made_by: Any, names: tuple[str, ...]) -> Any:
    """The kernels' view of a record's tensors, which is not a copy."""
    tensors = {name: getattr(record, name) for name in names}
    places = tuple(0 if tensor is None else tensor.data_ptr() for tensor in tensors.values())
    known = _handles.get(id(record))
    if known is not None and known[0] == places:
        return known[1]
    for name, tensor in tensors.items():
        if tensor is not None and (tensor.dtype != torch.float32 or not tensor.is_contiguous()):
            raise UsageError(f"`{name}` must be contiguous float32 here, got {tensor.dtype}. Convert it first.")
    if known is None:
        weakref.finalize(record, _handles.pop, id(record), None)
    _handles[id(record)] = places, made_by(*tensors.values())
    return _handles[id(record)][1]


MOST_VIEWS = 1024


class _Views(dict[tuple[Any, ...], Any]):
    """Cameras as the kernels want them, by everything that makes them."""

    def of(self, camera: Cameras, settings: RasterSettings) -> Any:
        """The one camera of `camera`."""
        viewmat, K = camera.viewmats[0].detach(), camera.Ks[0].detach()
        drawn_by = settings.near_plane, settings.far_plane, settings.eps2d, settings.antialiased
        size = camera.width, camera.height
        key = viewmat.numpy().tobytes(), viewmat.dtype, K.numpy().tobytes(), K.dtype, size, drawn_by
        if key not in self:
            if len(self) >= MOST_VIEWS:
                self.clear()
            self[key] = _cpu.Camera(viewmat.flatten().tolist(), K.flatten().tolist(), *size, *drawn_by)
        return self[key]
