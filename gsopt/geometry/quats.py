"""Quaternions wxyz: to and from rotation matrices, product, conjugate. Any norm > 0 gives the same rotation."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def normalize(quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 4"]:
    """Unit quaternions. A zero quaternion gives NaN: refuse it at the border (`Gaussians.validate`)."""
    # The largest component is divided out first, so that no square leaves the range of the dtype. It is held constant
    # for autograd: the result does not depend on it.
    scaled = quats / quats.detach().abs().amax(dim=-1, keepdim=True)
    return scaled / torch.linalg.vector_norm(scaled, dim=-1, keepdim=True)


def rotation_matrices(quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 3 3"]:
    """R(q / |q|), so that R(q) v = q v q*/|q|² (docs/math.md, eq. 3)."""
    w, x, y, z = normalize(quats).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def from_rotation_matrices(matrices: Float[Tensor, "*N 3 3"]) -> Float[Tensor, "*N 4"]:
    """Unit quaternions with w >= 0. Each row of `outer` is 4 q_i q; the row with the largest q_i loses no
    digits (Shepperd 1978)."""
    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 1, 0] + m[..., 0, 1], m[..., 2, 0] + m[..., 0, 2], m[..., 2, 1] + m[..., 1, 2]
    # Row i is 4 q_i q; the largest diagonal element marks the best conditioned row.
    outer = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, wx, wy, wz], dim=-1),
            torch.stack([wx, 1 + xx - yy - zz, xy, xz], dim=-1),
            torch.stack([wy, xy, 1 - xx + yy - zz, yz], dim=-1),
            torch.stack([wz, xz, yz, 1 - xx - yy + zz], dim=-1),
        ],
        dim=-2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = torch.take_along_dim(outer, best[..., None, None].expand(*best.shape, 1, 4), dim=-2)[..., 0, :]
    quats = normalize(row)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def multiply(left: Float[Tensor, "*N 4"], right: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 4"]:
    """Hamilton product: R(multiply(p, q)) = R(p) R(q)."""
    pw, px, py, pz = left.unbind(-1)
    qw, qx, qy, qz = right.unbind(-1)
    product = (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )
    return torch.stack(product, dim=-1)


def conjugate(quats: Float[Tensor, "*N 4"]) -> Float[Tensor, "*N 4"]:
    """The inverse rotation, same norm."""
    return quats * quats.new_tensor([1.0, -1.0, -1.0, -1.0])
