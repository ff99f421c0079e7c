"""References carried over by depth: exact where the surface is the same, untrusted where it is not."""

from __future__ import annotations

import torch

from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.projection import project
from gsopt.sds.warp import lift, warp

SIZE = 48


def camera(x: float) -> Cameras:
    eye = torch.tensor([[x, 0.0, -3.0]], dtype=torch.float64)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    viewmats = look_at(eye, torch.zeros(3, dtype=torch.float64), up)
    return Cameras(viewmats.float(), intrinsics(0.8, SIZE, SIZE)[None].float(), SIZE, SIZE)


def plane_depth(seen_from: Cameras) -> torch.Tensor:
    """z of the plane Z = 0 at every pixel center."""
    rays = lift(seen_from, torch.ones(SIZE, SIZE)) - seen_from.centers[0]
    return -seen_from.centers[0, 2] / rays[..., 2]


def painted(seen_from: Cameras) -> torch.Tensor:
    """A smooth picture on the plane."""
    x, y, _ = lift(seen_from, plane_depth(seen_from)).unbind(-1)
    return torch.stack([0.5 + 0.4 * torch.sin(2 * x), 0.5 + 0.4 * torch.cos(3 * y), 0.5 + 0.2 * x * y])


def test_lifting_is_the_inverse_of_projection() -> None:
    here = camera(0.7)
    here.viewmats[0, :3, 3] += torch.tensor([0.3, -0.2, 0.1])  # no axis looks through the origin
    depth = 2 + torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    column, row, z = project(here, lift(here, depth).view(-1, 3))
    i, j = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    torch.testing.assert_close(column.view(SIZE, SIZE), j, atol=1e-4, rtol=0)
    torch.testing.assert_close(row.view(SIZE, SIZE), i, atol=1e-4, rtol=0)
    torch.testing.assert_close(z.view(SIZE, SIZE), depth, atol=1e-5, rtol=0)


def test_another_view_of_the_same_surface_has_its_colors() -> None:
    here, there = camera(0.0), camera(0.6)
    one = torch.ones(SIZE, SIZE)
    found = warp(here, plane_depth(here), one, painted(there)[None], one[None, None], plane_depth(there)[None], there)[
        0
    ]
    inner = slice(8, -8)
    trusted = found[3, inner, inner]
    assert float(trusted.min()) > 0.99
    assert float((found[:3] - painted(here))[:, inner, inner].abs().max()) < 2e-3


def test_a_surface_hidden_there_is_not_trusted() -> None:
    """The reference shows something a fifth nearer on its left half."""
    here, there = camera(0.0), camera(0.0)
    depth = plane_depth(there)
    depth[:, : SIZE // 2] *= 0.8
    one = torch.ones(SIZE, SIZE)
    confidence = warp(here, plane_depth(here), one, painted(there)[None], one[None, None], depth[None], there)[0, 3]
    assert float(confidence[:, : SIZE // 2 - 1].max()) < 1e-6
    assert float(confidence[:, SIZE // 2 + 1 :].min()) > 0.99


def test_nothing_is_trusted_where_there_is_nothing() -> None:
    """No depth here, no alpha here, no alpha there, or outside the reference: confidence 0."""
    here = camera(0.0)
    one, nothing, depth = torch.ones(SIZE, SIZE), torch.zeros(SIZE, SIZE), plane_depth(here)
    picture = painted(here)[None]
    for z, alpha, there, reference in (
        (nothing, one, one, here),
        (depth, nothing, one, here),
        (depth, one, nothing, here),
        (depth, one, one, camera(40.0)),
    ):
        found = warp(here, z, alpha, picture, there[None, None], depth[None], reference)
        assert bool(torch.isfinite(found).all())
        assert float(found[0, 3].max()) < 1e-6
