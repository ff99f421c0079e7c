"""Views between the photos, where no image says what shows: what is thin there is haze, and fades.

Few photos agree with matter that none of them can tell from the object: it lies before or behind the object in each,
half transparent, and other views show it as fog. The term asks of such views that every pixel show the object or
nothing: weight · mean(a (2 m - a)) over their alphas a, with m = SOLID. Its gradient, 2 weight (m - a) / n, thins what
is less opaque than m and closes what is more (docs/decisions/0017-unseen-views.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.scene import Scene
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.focus import find_focus
from gsopt.geometry.surrounding import surrounding_cameras
from gsopt.raster.backend import Backend, Gradients, RasterSettings

SOLID = 0.8
"""Alpha above which a pixel shows the object: at 1 the term eats round things away, at 0.5 it hardens the haze."""
COUNT = 16
"""Number of cameras around the object."""
TURN = 7
"""Cameras from one use to the next, so that neighbors do not follow each other; it shares no divisor with COUNT."""
EVERY = 4
"""Steps from one use to the next."""
DOWNSCALE = 2
"""A photo's edge over that of their images: haze is wide."""
FROM_SHARE = 0.3
"""Share of the run before the first use: the photos shape the object first."""
NEEDED = ("means", "quats", "log_scales", "logit_opacities")
"""The parameters that alpha depends on."""


@dataclass(frozen=True)
class UnseenViews:
    """Cameras around the object that take turns."""

    cameras: Cameras
    weight: float
    first: int
    """Step of the first use."""

    @staticmethod
    def of(scene: Scene, weight: float, iterations: int) -> UnseenViews | None:
        """The cameras, or None where the term has no weight or the photos do not look at one object with masks."""
        cameras = [view.camera for view in scene.train]
        focus = find_focus(cameras, scene.extent)
        if weight == 0 or not scene.has_alpha or not focus.converging:
            return None
        lens = cameras[0].resized(*(max(1, extent // DOWNSCALE) for extent in (cameras[0].width, cameras[0].height)))
        return UnseenViews(surrounding_cameras(lens, focus.point, COUNT), weight, round(FROM_SHARE * iterations))

    def add(self, step: int, gaussians: Gaussians, backend: Backend, gradients: Gradients) -> None:
        """Add the term's gradient of a step, in place."""
        if step < self.first or step % EVERY != 0:
            return
        camera = self.cameras[step // EVERY * TURN % COUNT]
        frame = backend.forward(gaussians, camera, RasterSettings(sh_degree=0), torch.zeros(3))
        v_alphas = haze_gradient(frame.alphas, self.weight)
        own = backend.backward(frame, torch.zeros_like(frame.colors), v_alphas, bands=False)
        for name in NEEDED:
            getattr(gradients, name).add_(getattr(own, name))


def haze_gradient(alphas: Float[Tensor, "H W"], weight: float) -> Float[Tensor, "H W"]:
    """d/dalphas of weight · mean(a (2 SOLID - a))."""
    return torch.sub(SOLID, alphas).mul_(2 * weight / alphas.numel())
