"""The shapes of a library as volumes on one device, and which of them are held out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.errors import InputError, UsageError
from gsopt.shape_library.entry import Entry
from gsopt.shape_library.library_file import ShapeLibrary

HELD_SHARE = 12
"""One entry in so many is held out when none is named, by the hash of its id: the same ones in every library."""
MAX_TRAINED = 20_000
"""Entries of a library that are trained on: each takes 120 KB of the device's memory."""
GRAY = 0.5


@dataclass(frozen=True)
class ShapeVolumes:
    """Shapes as tensors, with what is known about them."""

    occupied: Bool[Tensor, "N s s s"]
    colors: Float[Tensor, "N 3 c c c"]
    """0..1, continued into cells without a surface."""
    sizes: Float[Tensor, "N 3"]
    entries: tuple[Entry, ...]

    def __len__(self) -> int:
        return len(self.entries)

    @staticmethod
    def read(library: ShapeLibrary, rows: Sequence[int], device: torch.device) -> ShapeVolumes:
        """Raises InputError for a broken library."""
        shapes = [library.shape(row) for row in rows]
        colors = torch.stack([torch.from_numpy(shape.colors.copy()) for shape in shapes])
        return ShapeVolumes(
            torch.stack([torch.from_numpy(shape.occupied) for shape in shapes]).to(device),
            continued(colors.permute(0, 4, 1, 2, 3).float() / 255).to(device),
            torch.stack([torch.from_numpy(shape.sizes.copy()) for shape in shapes]).to(device),
            tuple(library.entries[row] for row in rows),
        )


def continued(colors: Float[Tensor, "N 3 c c c"]) -> Float[Tensor, "N 3 c c c"]:
    """Black cells, which have no surface, in the mean color of their neighbors, ring by ring; gray without any."""
    known = (colors.amax(1, keepdim=True) > 0).float()
    filled = colors * known
    for _ in range(colors.shape[-1]):
        weight = torch.nn.functional.avg_pool3d(known, 3, stride=1, padding=1)
        mean = torch.nn.functional.avg_pool3d(filled, 3, stride=1, padding=1) / weight.clamp_min(1e-6)
        filled = torch.where(known > 0, filled, mean * (weight > 0))
        known = (weight > 0).float()
    return torch.where(known > 0, filled, torch.full_like(filled, GRAY))


def split(library: ShapeLibrary, held: Sequence[str]) -> tuple[list[int], list[int]]:
    """Rows to train on, and rows held out: those named, else one in HELD_SHARE."""
    ids = [entry.id for entry in library.entries]
    unknown = [name for name in held if name not in set(ids)]
    if unknown:
        raise UsageError(f"`--val` names {unknown[0]!r}, which is no id of the {len(ids)} entries. Correct it.")
    chosen = set(held) or {name for name in ids if _draw(name) % HELD_SHARE == 0}
    train = [row for row, name in enumerate(ids) if name not in chosen]
    if not train:
        raise InputError(f"{library.path} holds {len(ids)} entries, all of them held out. Give a library of more.")
    if len(train) > MAX_TRAINED:
        train = [train[i * len(train) // MAX_TRAINED] for i in range(MAX_TRAINED)]
    return train, [row for row, name in enumerate(ids) if name in chosen]


def _draw(name: str) -> int:
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "little")
