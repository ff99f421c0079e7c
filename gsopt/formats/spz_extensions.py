"""The extension records of .spz: type, length and payload, one after the other.

Source: extensions/README.md and splat-types.h of github.com/nianticlabs/spz. Records of an unknown type are skipped
with a warning, as the reference does; SPZ_ADOBE_coordinate_system names the axes of the file.
"""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.errors import InputError, InputWarning

RIGHT_UP_BACK = "RUB"
_RECORD = struct.Struct("<II")
_SAFE_ORBIT_CAMERA = 0xADBE0002
_COORDINATE_SYSTEM = 0xADBE0003
_FRAMES = (
    *("RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU", "RFU"),
)
"""Meaning of +x, +y, +z for each number; 0 is unspecified and counts as the format's own axes."""
_AXES = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""Directions in the frame of a PLY: right, down, forward."""


def frame_of(records: bytes, path: Path) -> str:
    """The letters of the file's axes, RUB unless a record names others. Warns about records that were skipped."""
    frame, at, skipped = RIGHT_UP_BACK, 0, []
    while at + _RECORD.size <= len(records):
        kind, length = _RECORD.unpack_from(records, at)
        payload = records[at + _RECORD.size : at + _RECORD.size + length]
        if len(payload) < length:
            raise InputError(f"{path}: extension {kind:#010x} claims {length} bytes, got {len(payload)}. Export again.")
        if kind == _COORDINATE_SYSTEM:
            frame = _frame(payload, path)
        elif kind != _SAFE_ORBIT_CAMERA:
            skipped.append(f"{kind:#010x}")
        at += _RECORD.size + length
    if skipped:
        names = ", ".join(dict.fromkeys(skipped))[:80]
        warnings.warn(f"{path}: unknown extensions were skipped: {names}.", InputWarning, stacklevel=2)
    return frame


def _frame(payload: bytes, path: Path) -> str:
    number = int.from_bytes(payload[:4], "little")
    if len(payload) != 4 or number >= len(_FRAMES):
        raise InputError(f"{path}: its coordinate system must be 0 to 16, got {payload[:8].hex()}. Export it again.")
    return _FRAMES[number]


def ply_from_frame(frame: str) -> Float[Tensor, "3 3"]:
    """The matrix that brings coordinates of that frame into a PLY's."""
    return torch.tensor([_AXES[letter] for letter in frame], dtype=torch.float64).T
