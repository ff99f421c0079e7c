"""A photo at the size that is matched, and the rays of its pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras
from gsopt.init.thumbnails import Thumbnail

LUMA_WEIGHTS = (0.299, 0.587, 0.114)
"""Rec. 601."""
_WIDTH_MULTIPLE = 8
_WINDOW = 7
"""Side of the window in which structure is looked for, px."""


@dataclass(frozen=True)
class StereoImage:
    """A photo whose width is a multiple of 8, as the matching kernel requires."""

    camera: Cameras
    rgb: Float[Tensor, "3 H W"]
    """0..1."""

    @staticmethod
    def of(photo: Thumbnail, pixels: int) -> StereoImage:
        """The photo with about `pixels` pixels, no more than it has."""
        shrink = math.sqrt(min(1.0, pixels / (photo.camera.width * photo.camera.height)))
        width = max(_WIDTH_MULTIPLE, round(photo.camera.width * shrink / _WIDTH_MULTIPLE) * _WIDTH_MULTIPLE)
        height = max(_WIDTH_MULTIPLE, round(photo.camera.height * shrink))
        rgb = torch.nn.functional.interpolate(photo.planes[None, :3].float() / 255, (height, width), mode="area")[0]
        return StereoImage(photo.camera.resized(width, height), rgb)

    @cached_property
    def gray(self) -> Float[Tensor, "H W"]:
        red, green, blue = self.rgb
        return LUMA_WEIGHTS[0] * red + LUMA_WEIGHTS[1] * green + LUMA_WEIGHTS[2] * blue

    @cached_property
    def structure(self) -> Float[Tensor, "H W"]:
        """Root mean squared change of gray per pixel in a window, in the direction in which it changes least: near zero
        on plain surfaces and along straight edges (Shi & Tomasi 1994)."""
        padded = torch.nn.functional.pad(self.gray[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
        across, down = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2, (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
        a, b, c = window_mean(torch.stack([across * across, across * down, down * down]), _WINDOW)
        return ((a + c) / 2 - torch.hypot((a - c) / 2, b)).clamp(min=0).sqrt()

    @cached_property
    def pixels(self) -> Float[Tensor, "2 H W"]:
        """Column and row of the pixels' centers."""
        rows, columns = torch.arange(self.camera.height) + 0.5, torch.arange(self.camera.width) + 0.5
        return torch.stack([columns.expand(len(rows), -1), rows[:, None].expand(-1, len(columns))])

    @cached_property
    def rays(self) -> Float[Tensor, "2 H W"]:
        """x and y at depth 1 of each pixel's ray, in the camera's coordinates."""
        K = self.camera.Ks[0]
        column, row = self.pixels
        return torch.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]])

    def points(self, inverse_depths: Float[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
        """World points; written out by coordinate, so that no matrix product's blocking decides the last bit."""
        R, center = self.camera.viewmats[0, :3, :3], self.camera.centers[0]
        x, y = self.rays
        return torch.stack([(x * R[0, k] + y * R[1, k] + R[2, k]) / inverse_depths + center[k] for k in range(3)], -1)


def window_mean(planes: Float[Tensor, "C H W"], side: int) -> Float[Tensor, "C H W"]:
    """Mean over the part of a square window that lies in the image."""
    return torch.nn.functional.avg_pool2d(planes[None], side, 1, side // 2, count_include_pad=False)[0]
