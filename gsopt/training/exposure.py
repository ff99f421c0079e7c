"""Exposure and white balance of the input photos, learned beside the Gaussians (`--exposure`).

The render of photo i is multiplied by exp(log_gains_i), one factor per channel, before it is compared: in sRGB-coded
values a factor of the light is a factor too, but for the darkest tones. The log gains have mean zero over the photos,
which fixes what else nothing would: the Gaussians may not darken while all photos brighten. A background that was
added to a photo has no exposure and is left alone. (Appearance per photo: Martin-Brualla et al. 2021; an affine map:
Kerbl et al. 2024.)
"""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.train import ExposureConfig
from gsopt.data.scene import Scene
from gsopt.raster.backend import RenderedFrame

TENSORS = ("log_gains", "exp_avg", "exp_avg_sq", "steps")
BETA1, BETA2, EPS = 0.9, 0.99, 1e-15
"""Adam's constants; a photo is seen once per epoch."""


class Exposure:
    """The log gains of the input photos, and what Adam remembers of them; float64."""

    def __init__(self, config: ExposureConfig, scene: Scene, iterations: int) -> None:
        self.config, self.iterations = config, iterations
        self.names = [view.name for view in scene.train]
        rows = {view.index: row for row, view in enumerate(scene.train)}
        own = [view.store is scene.train[0].store for view in scene.drawn]
        self._rows = [rows.get(view.index) if kept else None for view, kept in zip(scene.drawn, own, strict=True)]
        self.log_gains = torch.zeros(len(scene.train), 3, dtype=torch.float64)
        self._exp_avg, self._exp_avg_sq = torch.zeros_like(self.log_gains), torch.zeros_like(self.log_gains)
        self._steps = torch.zeros(len(scene.train), dtype=torch.int64)

    def row(self, index: int) -> int | None:
        """Returns the photo that drawn view `index` shows, mirrored or not, or None for a view that nobody took."""
        return self._rows[index]

    def exposed(self, row: int, frame: RenderedFrame, background: Float[Tensor, "3"] | None) -> Float[Tensor, "H W 3"]:
        """Multiplies a render by the photo's gains, but for what is left of the background."""
        gain = self._gain(row, frame)
        colors = frame.colors * gain
        return colors if background is None else colors.addcmul_(_left(frame, background), 1 - gain)

    def backward(
        self,
        row: int,
        step: int,
        frame: RenderedFrame,
        background: Float[Tensor, "3"] | None,
        v_exposed: Float[Tensor, "H W 3"],
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"] | None]:
        """dLoss/d(colors) and dLoss/d(alphas) from dLoss/d(exposed); the photo's log gains take an Adam step."""
        gain = self._gain(row, frame)
        shown = frame.colors if background is None else frame.colors - _left(frame, background)
        self._update(row, step, (v_exposed * shown).sum((0, 1)).mul(gain).cpu().double())
        v_alphas = None
        if background is not None:
            v_alphas = (v_exposed * ((gain - 1) * background.to(gain))).sum(2)
        return v_exposed * gain, v_alphas

    def _gain(self, row: int, frame: RenderedFrame) -> Float[Tensor, "3"]:
        return self.log_gains[row].exp().to(frame.colors)

    def _update(self, row: int, step: int, gradient: Float[Tensor, "3"]) -> None:
        if step <= self.config.start:
            return
        self._steps[row] += 1
        seen = int(self._steps[row])
        self._exp_avg[row].lerp_(gradient, 1 - BETA1)
        self._exp_avg_sq[row].lerp_(gradient.square(), 1 - BETA2)
        root = (self._exp_avg_sq[row] / (1 - BETA2**seen)).sqrt()
        self.log_gains[row] -= self.rate(step) * (self._exp_avg[row] / (1 - BETA1**seen)) / (root + EPS)
        self.log_gains -= self.log_gains.mean(0)

    def rate(self, step: int) -> float:
        """Log-linear from `lr` to `lr_final`."""
        share = (step - self.config.start) / max(1, self.iterations - self.config.start)
        return math.exp((1 - share) * math.log(self.config.lr) + share * math.log(self.config.lr_final))

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint."""
        return dict(zip(TENSORS, (self.log_gains, self._exp_avg, self._exp_avg_sq, self._steps), strict=True))

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `tensors`, of the same shapes."""
        for name, own in self.tensors().items():
            own.copy_(tensors[name])

    def record(self) -> dict[str, Any]:
        """exposure.json: the factors by which each photo is brighter than the splats, red, green and blue."""
        gains = self.log_gains.exp().tolist()
        rows = zip(self.names, gains, strict=True)
        return {"version": 1, "views": [{"name": name, "gains": gain} for name, gain in rows]}


def _left(frame: RenderedFrame, background: Float[Tensor, "3"]) -> Float[Tensor, "H W 3"]:
    """The background's share of a render."""
    return (1 - frame.alphas)[..., None] * background.to(frame.colors)
