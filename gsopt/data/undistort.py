"""Replaces a real lens by a pinhole: chooses the pinhole, then samples the stored image where each of its rays fell.

The forward lens model is closed form, so the target-to-source map is exact: no inverse distortion is ever iterated.
The pinhole keeps the image size, the principal point and the ratio fx/fy; only the focal length is scaled, by the
smallest factor for which every target pixel has a source pixel. So nothing has to be masked, and barrel distortion
keeps its wider view (down to `ZOOM_MIN`, below which detail in the middle would be given away for the rim).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.lens import Lens
from gsopt.errors import InputError

ZOOM_MIN, ZOOM_MAX = 0.8, 8.0
_BISECTIONS = 40
_TEST_POINTS = 65
"""Pixels along each side that `_covers` tests."""
_BAND_ROWS = 256


@dataclass(frozen=True)
class Undistortion:
    """The lens and intrinsics of the stored image, and the pinhole that replaces them."""

    lens: Lens
    K: Float[Tensor, "3 3"]
    """Intrinsics of the stored image, float64."""
    pinhole: Float[Tensor, "3 3"]
    """Intrinsics of the undistorted image of the same size, float64."""
    width: int
    height: int

    def source_from_target(self, pixels: Float[Tensor, "*B 2"]) -> Float[Tensor, "*B 2"]:
        """Stored pixel coordinates for undistorted ones (both with centers at +0.5), float64."""
        return _source_from_target(self.lens, self.K, self.pinhole, pixels)

    def sample_grid(self) -> Float[Tensor, "H W 2"]:
        """`grid_sample` coordinates (-1..1 over the image area) of every target pixel, float32."""
        bands = [
            self.source_from_target(_pixel_centers(self.width, top, min(top + _BAND_ROWS, self.height))).float()
            for top in range(0, self.height, _BAND_ROWS)
        ]
        return torch.cat(bands) * torch.tensor([2 / self.width, 2 / self.height]) - 1


def undistort(planes: Float[Tensor, "C H W"], grid: Float[Tensor, "H W 2"]) -> Float[Tensor, "C H W"]:
    """Bilinear sample of premultiplied planes at a `sample_grid`."""
    sampled = torch.nn.functional.grid_sample(
        planes[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0]


def choose_pinhole(lens: Lens, K: Float[Tensor, "3 3"], width: int, height: int, where: str) -> Undistortion:
    """The widest pinhole (see the module's text) whose pixels all lie inside the stored image.

    Raises InputError naming `where` when the distortion folds back or leaves the image even when zoomed in.
    """
    low, high = ZOOM_MIN, ZOOM_MAX
    if not _covers(lens, K, _zoomed(K, high), width, height):
        raise InputError(
            f"The lens distortion of {where} cannot be undone: it folds back or leaves the image. "
            "Check its coefficients and principal point, or undistort the images first."
        )
    if _covers(lens, K, _zoomed(K, low), width, height):
        high = low
    for _ in range(_BISECTIONS if high > low else 0):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _covers(lens, K, _zoomed(K, middle), width, height) else (middle, high)
    return Undistortion(lens, K, _zoomed(K, high), width, height)


def _zoomed(K: Tensor, factor: float) -> Tensor:
    return K * torch.tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]], dtype=K.dtype)


def _covers(lens: Lens, K: Tensor, pinhole: Tensor, width: int, height: int) -> bool:
    """True when target pixels land between the first and last pixel centers of the source, without folding over."""
    x = torch.linspace(0.5, width - 0.5, _TEST_POINTS, dtype=torch.float64)
    y = torch.linspace(0.5, height - 0.5, _TEST_POINTS, dtype=torch.float64)
    target = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    source = _source_from_target(lens, K, pinhole, target)
    last = torch.tensor([width, height], dtype=torch.float64) - 0.5
    if not bool(((source >= 0.5) & (source <= last)).all()):
        return False
    du, dv = source[:, 1:] - source[:, :-1], source[1:] - source[:-1]
    area = du[:-1, :, 0] * dv[:, :-1, 1] - du[:-1, :, 1] * dv[:, :-1, 0]
    return bool((area > 0).all())


def _source_from_target(lens: Lens, K: Tensor, pinhole: Tensor, pixels: Tensor) -> Tensor:
    focal, center = pinhole.diagonal()[:2], pinhole[:2, 2]
    return lens.distort((pixels.double() - center) / focal) * K.diagonal()[:2] + K[:2, 2]


def _pixel_centers(width: int, top: int, bottom: int) -> Tensor:
    x = torch.arange(width, dtype=torch.float64) + 0.5
    y = torch.arange(top, bottom, dtype=torch.float64) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
