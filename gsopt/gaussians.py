"""The parameter record of a scene: N anisotropic Gaussians, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt import check
from gsopt.errors import InputError

SMALLEST_QUAT = 1e-30
"""Largest component below which the reciprocal nears the end of float32's range, and the direction is lost."""

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians in world space, stored before activation (as the optimizer sees them).

    A color seen from unit direction d is `max(0, 0.5 + sum_k sh_k Y_k(d))`, sRGB-coded.
    """

    means: Float[Tensor, "N 3"]
    """Centers, scene units."""
    quats: Float[Tensor, "N 4"]
    """Rotations, wxyz, any norm > 0."""
    log_scales: Float[Tensor, "N 3"]
    """Natural logarithm of the standard deviations along the local axes."""
    logit_opacities: Float[Tensor, "N"]
    """Opacity before the sigmoid."""
    sh0: Float[Tensor, "N 1 3"]
    """Band 0 of the spherical harmonics (the base color)."""
    shN: Float[Tensor, "N K-1 3"]
    """Bands 1 and up, K = (sh_degree + 1)^2."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest stored band of the spherical harmonics."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "N"]:
        return torch.sigmoid(self.logit_opacities)

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) for every parameter, in a fixed order."""
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    def select(self, rows: Tensor) -> Gaussians:
        """The rows named by a boolean mask [N] or by indices [M], in that order."""
        indices = torch.nonzero(rows)[:, 0] if rows.dtype == torch.bool else rows
        # index_select is four times as fast as tensor[rows] on a CPU
        return Gaussians(**{name: tensor.index_select(0, indices) for name, tensor in self.items()})

    def append(self, other: Gaussians) -> Gaussians:
        """These rows, then the other's."""
        return Gaussians(**{name: torch.cat([tensor, getattr(other, name)]) for name, tensor in self.items()})

    def to(self, target: torch.dtype | torch.device | str) -> Gaussians:
        """Same record with every tensor moved or cast by `Tensor.to`."""
        return Gaussians(**{name: tensor.to(target) for name, tensor in self.items()})

    def with_sh_degree(self, degree: int) -> Gaussians:
        """Pad with zero bands or drop bands so that exactly `degree` is stored."""
        want = (degree + 1) ** 2 - 1
        shN = self.shN[:, :want]
        if shN.shape[1] < want:
            shN = torch.cat([shN, shN.new_zeros(len(self), want - shN.shape[1], 3)], dim=1)
        return replace(self, shN=shN.contiguous())

    def validate(self) -> Gaussians:
        """Return self if shapes agree, values are finite and no quaternion is zero; InputError says what and where."""
        n = len(self)
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "log_scales": (n, 3),
            "logit_opacities": (n,),
            "sh0": (n, 1, 3),
            "shN": (n, (self.sh_degree + 1) ** 2 - 1, 3),
        }
        for name, tensor in self.items():
            check.shape(name, tensor, expected[name])
            check.finite(name, tensor)
        zero = torch.nonzero(self.quats.abs().amax(dim=-1) < SMALLEST_QUAT)
        if len(zero):
            row = int(zero[0, 0])
            raise InputError(
                f"`quats` must not be zero, got {self.quats[row].tolist()} at row {row}. "
                "Give a wxyz quaternion of any norm, or remove that row."
            )
        return self
