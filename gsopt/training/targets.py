"""The images a step compares its rendering with: views on a background, as floats, at the step's resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.data.resample import area_downscale, downscaled_size, premultiply
from gsopt.data.scene import View
from gsopt.geometry.cameras import Cameras
from gsopt.training.content_window import content_window

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Target:
    """One view, ready to be compared."""

    camera: Cameras
    colors: Float[Tensor, "H W 3"]
    """On the background of the step."""
    alphas: Float[Tensor, "H W"] | None
    """Absent (None) for an image without alpha and mask."""
    size: tuple[int, int]
    """Height and width of the whole image, px, of which this may be a window."""
    color: float = 1.0
    """Weight of the colors in the loss."""
    inverse_depths: Float[Tensor, "H W"] | None = None
    """Any scale and shift will do; NaN where unknown, absent (None) without a map."""

    @property
    def images(self) -> dict[str, Any]:
        """All that has pixels, by field."""
        planes = {name: getattr(self, name) for name in ("colors", "alphas", "inverse_depths")}
        return {name: plane for name, plane in planes.items() if plane is not None}

    @property
    def share(self) -> float:
        """Share of the whole image's pixels."""
        return self.colors.shape[0] * self.colors.shape[1] / (self.size[0] * self.size[1])


def content_pixels(views: Sequence[View], most: int = 16) -> float:
    """Number of pixels of an image that show something, weighted by alpha: the mean over up to `most` spread views."""
    count = min(most, len(views))
    chosen = [views[i * len(views) // count] for i in range(count)]
    return sum(_content(view.pixels()) for view in chosen) / len(chosen)


def _content(pixels: UInt8[Tensor, "H W C"]) -> float:
    opaque = pixels.shape[2] < 4
    return float(pixels.shape[0] * pixels.shape[1]) if opaque else int(pixels[..., 3].sum(dtype=torch.int64)) / 255


class Targets:
    """Float targets of all input views. Keeps as many as fit into `budget` bytes, in the order of their first use.

    With a fixed background the composited color is kept; with a random one the premultiplied color, to which the
    background is added at every step.
    """

    def __init__(
        self, views: Sequence[View], fixed: Float[Tensor, "3"] | None, budget: int, device: torch.device = CPU
    ) -> None:
        self._views = views
        self._fixed = fixed
        self._device = device
        self._budget = budget
        self._factor = 1
        self._kept: dict[tuple[int, bool], Target] = {}
        self._bytes = 0

    def get(self, index: int, factor: int, background: Float[Tensor, "3"], *, whole: bool = True) -> Target:
        """View `index` with width and height divided by `factor`; not `whole`: the window where its alpha shows
        something. The tensors belong to the cache: do not write."""
        if factor != self._factor:
            self._kept.clear()
            self._factor, self._bytes = factor, 0
        target = self._view(index, whole)
        if self._fixed is not None or target.alphas is None:
            return target
        colors = torch.addcmul(target.colors, 1 - target.alphas[..., None], background.to(self._device))
        return replace(target, colors=colors)

    def _view(self, index: int, whole: bool) -> Target:
        """View `index`, kept from an earlier step or made now; a window is cut out of the whole."""
        if (index, whole) in self._kept:
            return self._kept[index, whole]
        entire = self._view(index, whole=True) if not whole else None
        target = self._make(index) if entire is None else cropped(entire)
        size = sum(image.nbytes for image in target.images.values()) if target is not entire else 0
        if self._bytes + size <= self._budget:
            self._kept[index, whole] = target
            self._bytes += size
        return target

    def _make(self, index: int) -> Target:
        view = self._views[index]
        height, width = (downscaled_size(extent, self._factor) for extent in (view.camera.height, view.camera.width))
        colors, alphas = premultiplied(view.pixels().to(self._device), width, height)
        if self._fixed is not None and alphas is not None:
            colors = torch.addcmul(colors, 1 - alphas[..., None], self._fixed.to(self._device))
        camera = view.camera.to(torch.float32).resized(width, height)
        depths = view.inverse_depths(height, width)
        return moved(Target(camera, colors, alphas, (height, width), view.color, depths), self._device)


def moved(target: Target, device: torch.device) -> Target:
    """The same with its images on `device`; the camera stays."""
    return replace(target, **{name: image.to(device) for name, image in target.images.items()})


def cropped(target: Target) -> Target:
    """The part of a whole target where its alpha shows something; all of it where there is no alpha."""
    window = content_window(target.alphas)
    if window is None or target.alphas is None:
        return target
    images: dict[str, Any] = {name: window.crop(image) for name, image in target.images.items()}
    return replace(target, camera=window.camera(target.camera), **images)


def premultiplied(
    pixels: UInt8[Tensor, "H W C"], width: int, height: int
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"] | None]:
    """Bytes to color times alpha, and alpha (None for three channels), both 0..1 and area-filtered."""
    planes = area_downscale(premultiply(pixels), width, height) / 255
    colors = planes[:3].permute(1, 2, 0).contiguous()
    return colors, planes[3].contiguous() if len(planes) == 4 else None
