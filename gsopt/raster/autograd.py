"""Any backend's forward and backward as one torch.autograd.Function."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsopt.errors import UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import Backend, RasterSettings

Image = tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"], Float[Tensor, "H W"] | None, Int[Tensor, "N 2"]]


def draw(
    backend: Backend,
    gaussians: Gaussians,
    camera: Cameras,
    settings: RasterSettings,
    background: Float[Tensor, "3"] | None,
    depth: bool,
) -> Image:
    """(colors, alphas, depths, radii) of one camera, differentiable in the six parameters and the background.

    The result can be differentiated once: a backend's frame is used up by its backward pass.
    """
    parameters = [tensor for _, tensor in gaussians.items()]
    return _Draw.apply(backend, camera, settings, depth, background, *parameters)


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        backend: Backend,
        camera: Cameras,
        settings: RasterSettings,
        depth: bool,
        background: Float[Tensor, "3"] | None,
        *parameters: Tensor,
    ) -> Image:
        frame = backend.forward(Gaussians(*parameters), camera, settings, background, depth=depth)
        # Aliases: what is returned gets ctx as its grad_fn, and a ctx that held it would never be freed.
        depths = None if frame.depths is None else frame.depths.detach()
        kept = replace(frame, colors=frame.colors.detach(), alphas=frame.alphas.detach(), depths=depths)
        ctx.backend, ctx.frame = backend, kept
        ctx.parameters = [(tensor.detach(), tensor._version) for tensor in parameters]  # detached: no cycle
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(frame.radii)
        return frame.colors, frame.alphas, frame.depths, frame.radii

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, v_colors: Tensor | None, v_alphas: Tensor | None, v_depths: Tensor | None, _v_radii: None
    ) -> tuple[Tensor | None, ...]:
        frame = ctx.frame
        v_colors = torch.zeros_like(frame.colors) if v_colors is None else v_colors.contiguous()
        v_background = (v_colors * (1 - frame.alphas[..., None])).sum((0, 1)) if ctx.needs_input_grad[4] else None
        if not any(ctx.needs_input_grad[5:]):
            return (None, None, None, None, v_background, *(None for _ in ctx.needs_input_grad[5:]))
        for name, (tensor, version) in zip(PARAMETERS, ctx.parameters, strict=True):
            if tensor._version != version:  # as torch's own functions refuse it
                raise UsageError(f"`{name}` must be as it was drawn, got other values. Draw again after changing it.")
        gradients = ctx.backend.backward(frame, v_colors, _contiguous(v_alphas), _contiguous(v_depths))
        return (None, None, None, None, v_background, *(getattr(gradients, name) for name in PARAMETERS))


def _contiguous(gradient: Tensor | None) -> Tensor | None:
    return None if gradient is None else gradient.contiguous()
