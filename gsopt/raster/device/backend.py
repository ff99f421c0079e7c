"""The GPU backend: kernels of this folder behind the Backend protocol. Float32 only; the same bits run after run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.errors import UsageError
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.precision import widest
from gsopt.raster.backend import AdamStep, Gradients, Photometric, RasterSettings, RenderedFrame, enough_memory
from gsopt.raster.device.camera import Views
from gsopt.raster.device.frame import SUM_FIELDS, TILE, Context, Entries, Segments, Splats
from gsopt.raster.device.layout import kernels, members
from gsopt.raster.device.runtime import THREADS, Runtime
from gsopt.raster.device.source import program
from gsopt.raster.tensors import as_float32, contiguous, overwritable

MOST_TENSORS = 6
"""Parameters of a Gaussian, which one launch of `adam` steps."""
NO_TENSOR = dict.fromkeys(("count", "first_block", "step_size", "inverse_root"), 0) | dict.fromkeys(
    ("gradient", "param", "exp_avg", "exp_avg_sq")
)
"""Fills the places that `adam` does not read."""
BAND_GROUP = 64
"""Gaussians of a block of `adam_bands`: `kBandGroup` in adam.h."""


class DeviceBackend:
    """Draws where `runtime` runs: the Gaussians must lie on its device, cameras may lie anywhere."""

    def __init__(self, runtime: Runtime) -> None:
        self.runtime = runtime
        self.name = runtime.name
        self.device = runtime.device
        self._views = Views(members(kernels(program())["project_gaussians"])["camera"])

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
        gaussians = as_float32(gaussians)
        self._require_here(gaussians)
        height, width = camera.height, camera.width
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        behind = (0.0, 0.0, 0.0) if background is None else tuple(background.tolist())
        with enough_memory(len(gaussians), width, height):
            view, P = self._views.of(camera, settings), _parameters(gaussians, settings)
            splats = Splats.of(len(gaussians), self.device)
            grid = {"tiles_x": tiles_x, "tiles_y": tiles_y}
            self._launch("project_gaussians", len(gaussians), camera=view, P=P, **grid, **vars(splats))
            entries = Entries.of(splats, tiles_x, tiles_x * tiles_y, self._launch)
            image = self._blend(splats, entries, (height, width), behind, depth)
        segments = Segments(image["ends"], image["tile_of"])
        context = Context(gaussians, view, P, behind, (height, width), splats, entries, segments, image["last"])
        return RenderedFrame(image["colors"], image["alphas"], image["depths"], splats.radii, context)

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
        """See `Backend.backward`."""
        context = frame.context
        assert isinstance(context, Context)
        context.take()
        splats, entries = context.splats, context.entries
        with enough_memory(len(context.gaussians), context.size[1], context.size[0]):
            gradients = overwritable(context.gaussians, absgrad, bands, into)
            sums = self._blend_backward(context, v_colors, v_alphas, v_depths)
        self._launch(
            "project_backward_gaussians",
            len(context.gaussians),
            camera=context.camera,
            P=context.parameters,
            records=splats.records,
            first_slot=entries.first_slot,
            tiles=splats.tiles,
            sums=sums,
            **vars(gradients),
        )
        return gradients

    def release(self, frame: RenderedFrame) -> None:
        """Mark a frame as used when no `backward` will follow."""
        assert isinstance(frame.context, Context)
        frame.context.take()

    def photometric(
        self, rendered: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lambda_dssim: float
    ) -> Photometric:
        """See `Backend.photometric`."""
        rendered, target = rendered.contiguous(), target.contiguous()
        height, width = rendered.shape[:2]
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        tiles = tiles_x * tiles_y
        with enough_memory(0, width, height):
            v_rendered, *maps = (torch.empty_like(rendered) for _ in range(4))
            sums = rendered.new_empty(3 * tiles, 2)
        arguments = {
            "width": width,
            "height": height,
            "tiles_x": tiles_x,
            "tiles": tiles,
            "weight_l1": (1 - lambda_dssim) / rendered.numel(),
            "weight_ssim": lambda_dssim / rendered.numel(),
            "rendered": rendered,
            "target": target,
            **dict(zip(("d_mean", "d_square", "d_product"), maps, strict=True)),
            "sums": sums,
            "v_rendered": v_rendered,
        }
        for kernel in ("ssim_of_tiles", "ssim_gradient"):
            self._launch(kernel, 3 * tiles * THREADS, **arguments)
        l1, ssim = (sums.sum(0, dtype=widest(self.device)) / rendered.numel()).tolist()
        return Photometric(l1, ssim, (1 - lambda_dssim) * l1 + lambda_dssim * (1 - ssim), v_rendered)

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
        """See `Backend.adam`. All tensors must be float32, contiguous and on the device."""
        rates = {"beta1": step.beta1, "beta2": step.beta2, "eps": step.eps}
        tensors, blocks = [], 0
        for name in sorted(step.lr, key=lambda name: name != "shN"):
            record = _stepped(name, gaussians, exp_avg, exp_avg_sq, step)
            gradient = getattr(gradients, name)
            if gradient is None:  # the first, while the means are those that were drawn
                self._adam_bands(gaussians, gradients, camera, settings, {**record, "rates": rates})
                continue
            tensors.append({**record, "gradient": gradient, "count": gradient.numel(), "first_block": blocks})
            blocks += -(-gradient.numel() // THREADS)
        of = tensors + [NO_TENSOR] * (MOST_TENSORS - len(tensors))
        self._launch("adam", blocks * THREADS, rates=rates, tensors=len(tensors), of=of)

    def _adam_bands(
        self,
        gaussians: Gaussians,
        gradients: Gradients,
        camera: Cameras,
        settings: RasterSettings,
        record: dict[str, Any],
    ) -> None:
        count = len(gaussians)
        self._launch(
            "adam_bands",
            -(-count // BAND_GROUP) * THREADS,
            camera=self._views.of(camera, settings),
            count=count,
            sh_degree=min(settings.sh_degree, gaussians.sh_degree),
            sh_rest=gaussians.shN.shape[1],
            means=gaussians.means,
            v_sh0=gradients.sh0,
            **record,
        )

    def _blend(
        self, splats: Splats, entries: Entries, size: tuple[int, int], behind: tuple[float, ...], depth: bool
    ) -> dict[str, Any]:
        height, width = size
        image: dict[str, Any] = {
            "colors": torch.empty(height, width, 3, device=self.device),
            "alphas": torch.empty(height, width, device=self.device),
            "depths": torch.empty(height, width, device=self.device) if depth else None,
            "last": torch.empty(height, width, dtype=torch.int32, device=self.device),
            **vars(Segments.of(entries)),
        }
        self._launch("blend", _pixels(size), **_lists(splats, entries, size, behind), **image)
        return image

    def _blend_backward(
        self, context: Context, v_colors: Tensor, v_alphas: Tensor | None, v_depths: Tensor | None
    ) -> Float[Tensor, "E 12"]:
        sums = torch.empty(len(context.entries.slots), SUM_FIELDS, device=self.device)
        self._launch(
            "blend_backward",
            len(context.segments.tile_of) * THREADS,
            **_lists(context.splats, context.entries, context.size, context.background),
            slots=context.entries.slots,
            last=context.last,
            **vars(context.segments),
            v_colors=contiguous(v_colors),
            v_alphas=contiguous(v_alphas),
            v_depths=contiguous(v_depths),
            sums=sums,
        )
        return sums

    def _launch(self, kernel: str, threads: int, **arguments: Any) -> None:
        """Start a kernel of so many threads."""
        if threads:
            self.runtime.launch(kernel, -(-threads // THREADS), arguments)

    def _require_here(self, gaussians: Gaussians) -> None:
        if gaussians.means.device != self.device:
            raise UsageError(
                f"The backend {self.name} draws Gaussians on {self.device}, got them on {gaussians.means.device}. "
                "Move them with Gaussians.to()."
            )


def _parameters(gaussians: Gaussians, settings: RasterSettings) -> Mapping[str, Any]:
    degree = min(settings.sh_degree, gaussians.sh_degree)
    sizes = {"count": len(gaussians), "sh_degree": degree, "sh_rest": gaussians.shN.shape[1]}
    return {**sizes, **dict(gaussians.items())}


def _pixels(size: tuple[int, int]) -> int:
    """Counts the pixels of whole tiles: a thread each."""
    return -(-size[0] // TILE) * -(-size[1] // TILE) * THREADS


def _lists(splats: Splats, entries: Entries, size: tuple[int, int], behind: tuple[float, ...]) -> dict[str, Any]:
    """The fields that both ways through the tiles read."""
    return {
        "width": size[1],
        "height": size[0],
        "tiles_x": -(-size[1] // TILE),
        "background": behind,
        "records": splats.records,
        "tile_begin": entries.tile_begin,
        "ids": entries.ids,
    }


def _stepped(
    name: str, gaussians: Gaussians, exp_avg: Gaussians, exp_avg_sq: Gaussians, step: AdamStep
) -> dict[str, Any]:
    """A parameter, its moments, and its rate over the bias corrections. Raises UsageError for what would be copied."""
    records = {"param": gaussians, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
    tensors = {kind: getattr(record, name) for kind, record in records.items()}
    for tensor in tensors.values():
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise UsageError(f"`{name}` must be contiguous float32 here, got {tensor.dtype}. Convert it first.")
    t = step.steps[name]
    rate = step.lr[name] / (1 - step.beta1**t)
    return {**tensors, "step_size": rate, "inverse_root": 1 / math.sqrt(1 - step.beta2**t)}
