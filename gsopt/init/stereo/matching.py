"""Matching costs of the pixels of one image against others, if each shows a given plane.

A pixel's plane is its inverse depth as a function of the ray (x, y, 1): w = a x + b y + c. It is the same function for
every pixel of one plane, so a neighbor's hypothesis needs no conversion, and the window around a pixel projects to
another image by two additions per tap. Windows are compared by normalized cross-correlation, their taps weighted by
how near in place and brightness they are to the center (Yoon & Kweon 2006; Schönberger et al. 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.init.stereo.image import StereoImage
from gsopt.raster import _cpu  # type: ignore[attr-defined]

RADIUS, STRIDE = 2, 2
"""A window is 5 x 5 taps, two pixels apart."""
BRIGHTNESS_SCALE = 0.1
"""Difference, of 0..1, over which a tap's weight falls to 1/e."""
LEAST_VARIANCE = 1e-5
"""Variance of brightness in a window below which it is noise, not texture."""
UNSEEN_COST = 2.0
"""The cost where a window lies outside the other image or behind it; the largest of all."""

_STEPS = range(-RADIUS * STRIDE, RADIUS * STRIDE + 1, STRIDE)
TAPS = [(float(dx), float(dy)) for dy in _STEPS for dx in _STEPS]


class Matcher:
    """The windows of one image against `sources`; `workspace` is from `cpu_backend.workspace`."""

    def __init__(self, reference: StereoImage, sources: Sequence[StereoImage], workspace: Any) -> None:
        self._workspace = workspace
        self._shape = (reference.camera.height, reference.camera.width)
        K = reference.camera.Ks[0]
        weights, centered = windows(reference.gray)
        deviation = ((weights * centered.square()).sum(0) + LEAST_VARIANCE).sqrt()
        blocks = [values.view(len(TAPS), -1, 8) for values in (weights, weights * centered)]
        self._windows = _cpu.Windows(
            torch.tensor(TAPS),
            reference.rays.reshape(2, -1).contiguous(),
            torch.stack(blocks).permute(2, 1, 0, 3).contiguous(),
            1 / deviation.flatten(),
            1 / float(K[0, 0]),
            1 / float(K[1, 1]),
            LEAST_VARIANCE,
            UNSEEN_COST,
        )
        self._sources = [(corners(source.gray), *_motion(reference, source)) for source in sources]

    def costs(self, planes: Float[Tensor, "3 H W"]) -> Float[Tensor, "S H W"]:
        """One minus the correlation with each source: 0 to 2."""
        costs = torch.empty(len(self._sources), *self._shape)
        planes = planes.contiguous()
        for cost, (image, A, T) in zip(costs, self._sources, strict=True):
            height, width = image.shape[:2]
            _cpu.match(self._workspace, self._windows, image, height, width, A, T, planes, cost)
        return costs


def windows(gray: Float[Tensor, "H W"]) -> tuple[Float[Tensor, "25 H W"], Float[Tensor, "25 H W"]]:
    """Weights of the taps of every pixel, of sum 1, and their brightness less the weighted mean."""
    height, width = gray.shape
    reach = RADIUS * STRIDE
    padded = torch.nn.functional.pad(gray[None], (reach,) * 4, mode="replicate")[0]
    taps = [
        padded[reach + int(dy) : reach + int(dy) + height, reach + int(dx) : reach + int(dx) + width] for dx, dy in TAPS
    ]
    values = torch.stack(taps)
    distance = torch.tensor(TAPS).square().sum(1).sqrt() / (2 * reach)
    weights = torch.exp(-(values - gray).abs() / BRIGHTNESS_SCALE - distance[:, None, None])
    weights = weights / weights.sum(0)
    return weights, values - (weights * values).sum(0)


def corners(gray: Float[Tensor, "H W"]) -> Float[Tensor, "H W 4"]:
    """The pixel, the one to its right, the one below and the one below that to the right."""
    right = torch.cat([gray[:, 1:], gray[:, -1:]], 1)
    both = torch.stack([gray, right], -1)
    return torch.cat([both, torch.cat([both[1:], both[-1:]])], -1)


def _motion(reference: StereoImage, source: StereoImage) -> tuple[Any, Any]:
    """A and T: a ray (x, y, 1) of inverse depth w is seen at the source's pixel A (x, y, 1) + T w, over its last."""
    motion = source.camera.viewmats[0].double() @ torch.linalg.inv(reference.camera.viewmats[0].double())
    K = source.camera.Ks[0].double()
    return (K @ motion[:3, :3]).flatten().tolist(), (K @ motion[:3, 3]).tolist()
