"""Pinhole cameras: `viewmats` are cam_from_world in OpenCV axes (+x right, +y down, +z forward)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check

OPENCV_FROM_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""Negates y and z: cameras of OpenGL and Blender (x right, y up, looking along -z) to OpenCV and back.

No other place in the project writes that flip down."""


def viewmats_from_opengl(world_from_cam: Float[Tensor, "*C 4 4"]) -> Float[Tensor, "*C 4 4"]:
    """Camera-to-world in OpenGL axes (NeRF-synthetic, nerfstudio, Blender) to cam_from_world in OpenCV axes."""
    flip = OPENCV_FROM_OPENGL.to(world_from_cam)
    return torch.linalg.inv(world_from_cam @ flip)


def opengl_from_viewmats(viewmats: Float[Tensor, "*C 4 4"]) -> Float[Tensor, "*C 4 4"]:
    """Inverse of `viewmats_from_opengl`."""
    flip = OPENCV_FROM_OPENGL.to(viewmats)
    return torch.linalg.inv(viewmats) @ flip


@dataclass(frozen=True)
class Cameras:
    """C pinhole cameras that share one image size. Pixel (column i, row j) has its center at (i + 0.5, j + 0.5)."""

    viewmats: Float[Tensor, "C 4 4"]
    """cam_from_world, OpenCV axes."""
    Ks: Float[Tensor, "C 3 3"]
    """Intrinsics in pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    width: int
    height: int

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index: int | slice) -> Cameras:
        rows = slice(index, index + 1 or None) if isinstance(index, int) else index
        return replace(self, viewmats=self.viewmats[rows], Ks=self.Ks[rows])

    @property
    def centers(self) -> Float[Tensor, "C 3"]:
        """Positions in world space."""
        R, t = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(R.transpose(1, 2) @ t[..., None])[..., 0]

    @property
    def forwards(self) -> Float[Tensor, "C 3"]:
        """Unit viewing directions in world space."""
        return torch.nn.functional.normalize(self.viewmats[:, 2, :3], dim=-1)

    def resized(self, width: int, height: int) -> Cameras:
        """The same cameras with another image size; the field of view is kept."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0]).to(self.Ks)
        return replace(self, Ks=self.Ks * scale[:, None], width=width, height=height)

    def to(self, target: torch.dtype | torch.device | str) -> Cameras:
        return replace(self, viewmats=self.viewmats.to(target), Ks=self.Ks.to(target))

    def validate(self) -> Cameras:
        """Return self if shapes agree, values are finite and focal lengths positive; else InputError or UsageError."""
        check.shape("viewmats", self.viewmats, (None, 4, 4))
        check.shape("Ks", self.Ks, (len(self), 3, 3))
        check.finite("viewmats", self.viewmats)
        check.finite("Ks", self.Ks)
        check.at_least("width", self.width, 1, "Give the image size in pixels.")
        check.at_least("height", self.height, 1, "Give the image size in pixels.")
        if len(self):
            smallest = float(torch.minimum(self.Ks[:, 0, 0], self.Ks[:, 1, 1]).min())
            check.at_least("focal length", smallest, 1e-12, "Give fx and fy in pixels, both positive.")
        return self

    @staticmethod
    def cat(cameras: list[Cameras]) -> Cameras:
        """One batch from several of the same image size."""
        return replace(
            cameras[0], viewmats=torch.cat([c.viewmats for c in cameras]), Ks=torch.cat([c.Ks for c in cameras])
        )

    @staticmethod
    def of_one_size(cameras: list[Cameras]) -> Cameras:
        """One batch with the image size of the first: others fill it, and what stands out of it is cut off."""
        return Cameras.cat([camera._filling(cameras[0].width, cameras[0].height) for camera in cameras])

    def _filling(self, width: int, height: int) -> Cameras:
        scale = max(width / self.width, height / self.height)
        Ks = self.Ks * self.Ks.new_tensor([scale, scale, 1])[:, None]
        Ks[:, :, 2] += Ks.new_tensor([(width - scale * self.width) / 2, (height - scale * self.height) / 2, 0])
        return replace(self, Ks=Ks, width=width, height=height)


def intrinsics(fov_x: float, width: int, height: int) -> Float[Tensor, "3 3"]:
    """Square-pixel intrinsics, principal point in the middle, from the horizontal field of view in radians."""
    focal = 0.5 * width / math.tan(0.5 * fov_x)
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64)


def look_at(eyes: Float[Tensor, "C 3"], target: Float[Tensor, "3"], up: Float[Tensor, "3"]) -> Float[Tensor, "C 4 4"]:
    """viewmats of cameras at `eyes` that look at `target`; where `up` is parallel to the view, another up is taken."""
    z = torch.nn.functional.normalize(target - eyes, dim=-1)
    x = torch.linalg.cross(z, up.expand_as(z))
    fallback = torch.linalg.cross(z, up.roll(1).expand_as(z))
    x = torch.where(x.norm(dim=-1, keepdim=True) < 1e-6, fallback, x)
    x = torch.nn.functional.normalize(x, dim=-1)
    y = torch.linalg.cross(z, x)
    R = torch.stack([x, y, z], dim=1)
    viewmats = torch.eye(4).to(eyes).repeat(len(eyes), 1, 1)
    viewmats[:, :3, :3] = R
    viewmats[:, :3, 3] = -(R @ eyes[..., None])[..., 0]
    return viewmats
