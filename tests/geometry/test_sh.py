"""Spherical harmonics: orthonormal, harmonic, with the field's signs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from gsopt.errors import UsageError
from gsopt.geometry import sh


def quadrature() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials of degree <= 15 over the sphere exactly: Gauss-Legendre in z
    times the trapezoidal rule around it."""
    z, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()
    directions = torch.stack(
        [r[:, None] * phi.cos(), r[:, None] * phi.sin(), z[:, None].expand(8, 16)], dim=-1
    ).flatten(0, 1)
    return directions, (weights[:, None] * (2 * math.pi / 16)).expand(8, 16).flatten()


def test_the_basis_is_orthonormal() -> None:
    directions, weights = quadrature()
    Y = sh.basis(directions, 3)
    gram = Y.T @ (weights[:, None] * Y)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-13, rtol=0)


def test_each_band_is_an_eigenspace_of_the_laplacian() -> None:
    # A homogeneous polynomial of degree l that is harmonic in space; every band is written as one.
    point = torch.tensor([0.3, -0.7, 0.4], dtype=torch.float64)
    for k in range(16):
        degree = math.isqrt(k)
        hessian = torch.autograd.functional.hessian(lambda p, k=k: sh.basis(p, 3)[k], point)
        assert float(hessian.trace()) == pytest.approx(0, abs=1e-13)
        scaled, plain = sh.basis(2 * point, 3)[k], sh.basis(point, 3)[k]
        assert float(scaled) == pytest.approx(2**degree * float(plain), abs=1e-13)


def test_signs_and_order_are_those_of_the_field() -> None:
    # Values at the axes and one oblique direction that tell every sign and place of bands 1 to 3 apart.
    axes = torch.eye(3, dtype=torch.float64)
    c1, c2 = 0.4886025119029199, 0.31539156525252005
    expected = torch.zeros(3, 4, dtype=torch.float64)
    expected[0, 3], expected[1, 1], expected[2, 2] = -c1, -c1, c1
    expected[:, 0] = 0.28209479177387814
    torch.testing.assert_close(sh.basis(axes, 1), expected, atol=1e-15, rtol=0)
    assert sh.basis(axes, 2)[:, 6].tolist() == pytest.approx([-c2, -c2, 2 * c2])
    oblique = torch.tensor([0.6, 0.64, 0.48], dtype=torch.float64)
    signs = sh.basis(oblique, 3)[4:].sign().tolist()
    # xy, -yz, 2zz-xx-yy, -xz, xx-yy | -y(3xx-yy), xyz, -y(4zz-xx-yy), z(2zz-3xx-3yy), -x(...), z(xx-yy), -x(xx-3yy)
    assert signs == [1, -1, -1, -1, -1, -1, 1, -1, -1, -1, -1, 1]


def test_evaluation_uses_the_bands_that_are_asked_for_and_stored() -> None:
    rng = torch.Generator().manual_seed(0)
    sh0, shN = (torch.randn(5, k, 3, generator=rng, dtype=torch.float64) for k in (1, 8))
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=rng, dtype=torch.float64), dim=-1)
    full = sh.evaluate(sh0, shN, directions, 2)
    assert torch.equal(sh.evaluate(sh0, shN, directions, 3), full)
    flat = sh.evaluate(sh0, shN, directions, 0)
    torch.testing.assert_close(flat, sh.rgb_from_sh0(sh0[:, 0]).clamp_min(0))
    assert not torch.allclose(full, flat)
    by_hand = 0.5 + torch.einsum("nk,nkc->nc", sh.basis(directions, 2), torch.cat([sh0, shN], dim=1))
    torch.testing.assert_close(full, by_hand.clamp_min(0))
    assert float(by_hand.min()) < 0 <= float(full.min())


def test_base_colors_go_there_and_back() -> None:
    rgb = torch.rand(7, 3, dtype=torch.float64)
    torch.testing.assert_close(sh.rgb_from_sh0(sh.sh0_from_rgb(rgb)), rgb)


def test_bands_beyond_three_are_refused() -> None:
    with pytest.raises(UsageError, match=r"`sh_degree` must lie in \[0, 3\], got 4"):
        sh.basis(torch.eye(3), 4)
