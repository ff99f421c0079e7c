"""A run of a part of a scene: some of its views, and frozen Gaussians around those that learn."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.config.cells import CellConfig
from gsopt.data.scene import Scene
from gsopt.errors import InputError, shortened
from gsopt.formats import load_splats
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.sh import C0
from gsopt.raster.backend import AdamStep, Backend, Gradients, Photometric, RasterSettings, RenderedFrame
from gsopt.training.plan import RunPlan


def narrowed(cell: CellConfig, scene: Scene) -> Scene:
    """The scene with the cell's input views only; InputError for a name that it does not have."""
    if not cell.views:
        return scene
    known = {view.name: view for view in scene.train}
    if unknown := [name for name in cell.views if name not in known]:
        raise InputError(f"{scene.path} has no input view {shortened(unknown[0])}. Name some of its views.")
    return replace(scene, train=tuple(known[name] for name in cell.views))


def surrounded(plan: RunPlan, backend: Backend) -> Backend:
    """The backend, drawing the cell's frozen Gaussians too where it has some."""
    if not plan.cell.frozen:
        return backend
    first = load_splats(plan.cell.start) if plan.cell.start else None
    return Surrounded(backend, load_splats(plan.cell.frozen).with_sh_degree(plan.schedule.max_sh_degree), first)


class Surrounded:
    """A backend that draws frozen Gaussians with those of the run. They cover and light what they did, but nobody gets
    their gradients: neither optimizer nor density control knows of them."""

    def __init__(self, backend: Backend, frozen: Gaussians, first: Gaussians | None = None) -> None:
        """`first`: the run's first Gaussians. With them, what the frozen ones draw does not count in a pixel: it is not
        for the run to mend, which would put haze before it."""
        self._first = first
        self._shares: dict[tuple[Any, ...], UInt8[Tensor, "H W"]] = {}
        self.name, self.device = backend.name, backend.device
        self._backend, self._frozen = backend, frozen.to(torch.float32).to(backend.device)
        self._all = self._frozen
        """The run's Gaussians, then the frozen ones: the latter stay in place from frame to frame."""
        self._spent: Gradients | None = None

    def __len__(self) -> int:
        return len(self._frozen)

    def forward(
        self,
        gaussians: Gaussians,
        camera: Cameras,
        settings: RasterSettings,
        background: Float[Tensor, "3"] | None = None,
        *,
        depth: bool = False,
    ) -> RenderedFrame:
        """See `Backend.forward`; the frame has the radii of the run's Gaussians."""
        count = len(gaussians)
        if len(self._all) != count + len(self):
            self._all = gaussians.append(self._frozen)
        else:
            for name, values in gaussians.items():
                getattr(self._all, name)[:count] = values
        frame = self._backend.forward(self._all, camera, settings, background, depth=depth)
        return replace(frame, radii=frame.radii[:count], context=(frame, self._share(camera, settings)))

    def _share(self, camera: Cameras, settings: RasterSettings) -> UInt8[Tensor, "H W"] | None:
        """Share of each pixel of a camera that counts, 0 to 255: what the frozen ones leave of it at first."""
        if self._first is None:
            return None
        matrices = (values[0].cpu().numpy().tobytes() for values in (camera.viewmats, camera.Ks))
        key = (*matrices, camera.width, camera.height)
        if key not in self._shares:
            drawn = self._first.append(self._frozen.to("cpu").with_sh_degree(self._first.sh_degree))
            frozen = (torch.arange(len(drawn)) >= len(self._first)).float()
            colors = ((frozen - 0.5) / C0)[:, None, None].expand(-1, 1, 3).contiguous()
            flat = replace(drawn, sh0=colors, shN=drawn.shN[:, :0].contiguous()).to(self.device)
            frame = self._backend.forward(flat, camera, replace(settings, sh_degree=0))
            self._shares[key] = ((1 - frame.colors[..., 0]).clamp(0, 1) * 255).round().to(torch.uint8)
        return self._shares[key]

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
        """See `Backend.backward`. `into` is part of gradients that are kept here."""
        assert isinstance(frame.context, tuple)
        (whole, share), count = frame.context, len(frame.radii)
        if share is not None:
            weights = share.float() / 255
            v_colors = v_colors * weights[..., None]
            v_alphas = None if v_alphas is None else v_alphas * weights
            v_depths = None if v_depths is None else v_depths * weights
        how = {"absgrad": absgrad, "bands": bands}
        self._spent = self._backend.backward(whole, v_colors, v_alphas, v_depths, **how, into=self._spent)
        rows: dict[str, Any] = {}
        for field in fields(Gradients):
            tensor = getattr(self._spent, field.name)
            rows[field.name] = None if tensor is None else tensor[:count]
        return Gradients(**rows)

    def photometric(
        self, rendered: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lambda_dssim: float
    ) -> Photometric:
        """See `Backend.photometric`."""
        return self._backend.photometric(rendered, target, lambda_dssim)

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
        """See `Backend.adam`."""
        self._backend.adam(gaussians, gradients, exp_avg, exp_avg_sq, step, camera, settings)
