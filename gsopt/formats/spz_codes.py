"""Encoding of splat attributes as the byte codes of .spz, and decoding.

Formulas: src/cc/load-spz.cc of github.com/nianticlabs/spz.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gsopt.errors import InputError
from gsopt.formats.validation import BYTE_OPACITY_MARGIN, logit, opacity_bytes, to_bytes
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import normalize

_MAX_CODE = (1 << 23) - 1
_FINEST = 16
_COLOR_SCALE = 0.15
_SH1_STEP, _SH_STEP = 8, 16
"""Band 1 keeps 5 of 8 bits, bands 2 and 3 keep 4, as the format's own writer does, which makes the stream small."""
_HALF = math.sqrt(0.5)
_MAGNITUDE = 511


def stream_sizes(count: int, sh_degree: int, version: int) -> tuple[int, ...]:
    """Bytes of positions, alphas, colors, scales, rotations and bands 1 and up."""
    rotation = 3 if version == 2 else 4
    return 9 * count, count, 3 * count, 3 * count, rotation * count, 3 * count * ((sh_degree + 1) ** 2 - 1)


def pack(gaussians: Gaussians, path: Path) -> tuple[int, list[bytes]]:
    """(fraction bits of the positions, the six streams of version 3 and 4)."""
    fraction_bits = _fraction_bits(gaussians.means, path)
    streams = [
        _pack_positions(gaussians.means, fraction_bits),
        opacity_bytes(gaussians.opacities),
        to_bytes(gaussians.sh0 * (_COLOR_SCALE * 255) + 127.5),
        to_bytes((gaussians.log_scales + 10) * 16),
        _pack_smallest_three(gaussians.quats),
        _pack_bands(gaussians.shN),
    ]
    return fraction_bits, [np.asarray(stream).tobytes() for stream in streams]


def unpack(streams: Sequence[bytearray], count: int, sh_degree: int, version: int, fraction_bits: int) -> Gaussians:
    """Gaussians, still right, up, back, from six streams of the sizes that `stream_sizes` names."""
    positions, alphas, colors, scales, rotations, bands = (np.frombuffer(stream, np.uint8) for stream in streams)
    unpack_quats = _unpack_first_three if version == 2 else _unpack_smallest_three
    return Gaussians(
        means=_unpack_positions(positions.reshape(count, 3, 3), fraction_bits),
        quats=unpack_quats(rotations),
        log_scales=_floats(scales).reshape(count, 3) / 16 - 10,
        logit_opacities=logit(_floats(alphas) / 255, BYTE_OPACITY_MARGIN),
        sh0=((_floats(colors) / 255 - 0.5) / _COLOR_SCALE).reshape(count, 1, 3),
        shN=((_floats(bands) - 128) / 128).reshape(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def _floats(codes: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(codes.astype(np.float32))


def _fraction_bits(means: Float[Tensor, "N 3"], path: Path) -> int:
    """Number of fraction bits that 24 bits leave for the farthest splat."""
    farthest = float(means.abs().max()) if means.numel() else 0.0
    bits = min(_FINEST, math.floor(math.log2(_MAX_CODE / farthest))) if farthest > 0 else _FINEST
    if bits < 0:
        raise InputError(
            f"{path}: .spz holds coordinates to {_MAX_CODE}, got {farthest:g}. Use .ply or scale the scene."
        )
    return bits


def _pack_positions(means: Float[Tensor, "N 3"], fraction_bits: int) -> NDArray[np.uint8]:
    codes = (means.double() * (1 << fraction_bits)).round().to(torch.int32).numpy().astype("<i4")
    return np.ascontiguousarray(codes.view(np.uint8).reshape(-1, 3, 4)[:, :, :3])


def _unpack_positions(codes: NDArray[np.uint8], fraction_bits: int) -> Float[Tensor, "N 3"]:
    wide = np.zeros((len(codes), 3, 4), np.uint8)
    wide[:, :, 1:] = codes  # in the upper three bytes, so that the right shift extends the sign
    return torch.from_numpy((wide.view("<i4")[:, :, 0] >> 8).astype(np.float32)) / (1 << fraction_bits)


def _pack_smallest_three(quats: Float[Tensor, "N 4"]) -> NDArray[np.uint32]:
    """Bits 30-31 name the largest of x y z w; then, from the first of the others down, a sign and nine bits of
    magnitude each, relative to the largest one's sign and to sqrt(1/2)."""
    xyzw = normalize(quats.double())[:, [1, 2, 3, 0]].numpy()
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    magnitude = np.minimum(np.abs(xyzw) / _HALF * _MAGNITUDE + 0.5, _MAGNITUDE).astype(np.uint32)
    code = largest.astype(np.uint32)
    for i in range(4):
        field = (xyzw[:, i] < 0).astype(np.uint32) << 9 | magnitude[:, i]
        code = np.where(largest == i, code, code << 10 | field)
    return code.astype("<u4")


def _unpack_smallest_three(codes: NDArray[np.uint8]) -> Float[Tensor, "N 4"]:
    code = codes.view("<u4").astype(np.uint32)
    largest = code >> 30
    xyzw = np.zeros((len(code), 4), np.float32)
    for i in (3, 2, 1, 0):
        value = (code & 511).astype(np.float32) * np.float32(_HALF / _MAGNITUDE)
        xyzw[:, i] = np.where(largest == i, 0, np.where(code >> 9 & 1, -value, value))
        code = np.where(largest == i, code, code >> 10)
    rest = np.sqrt(np.maximum(0, 1 - np.square(xyzw).sum(axis=1)))
    np.put_along_axis(xyzw, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return torch.from_numpy(xyzw[:, [3, 0, 1, 2]])


def _unpack_first_three(codes: NDArray[np.uint8]) -> Float[Tensor, "N 4"]:
    """Version 2: x, y, z as bytes; w follows from the length and is not negative."""
    xyz = _floats(codes).reshape(-1, 3) / 127.5 - 1
    w = (1 - xyz.square().sum(dim=1, keepdim=True)).clamp_min(0).sqrt()
    return torch.cat([w, xyz], dim=1)


def _pack_bands(shN: Float[Tensor, "N K-1 3"]) -> Tensor:
    steps = torch.full((shN.shape[1], 1), float(_SH_STEP))
    steps[:3] = _SH1_STEP
    return (((shN * 128).round() + 128 + steps / 2).div(steps).floor() * steps).clamp(0, 255).to(torch.uint8)
