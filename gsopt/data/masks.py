"""Masks: black hides a pixel (alpha 0), white shows it; gray levels are partial alpha."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from gsopt.data import files
from gsopt.errors import InputError


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of image `name` (relative to its image folder): `name.ext.png` as COLMAP writes it, or `name.png`."""
    image = files.child(folder, name)
    if image.is_absolute() != folder.is_absolute() or ".." in image.parts or not image.is_relative_to(folder):
        image = folder / image.name  # the image lies elsewhere: never take it for its own mask
    for candidate in (image.with_name(image.name + ".png"), image.with_suffix(".png")):
        if files.is_regular(candidate):
            return candidate
    return None


def apply_mask(pixels: UInt8[Tensor, "H W C"], mask: UInt8[Tensor, "H W"], path: Path) -> UInt8[Tensor, "H W 4"]:
    """RGBA whose alpha is the mask, times the image's own alpha where it has one.

    Masks of 0 and 1 are taken as 0 and 255. InputError naming `path` when the sizes differ.
    """
    if mask.shape != pixels.shape[:2]:
        got, want = tuple(mask.shape), tuple(pixels.shape[:2])
        raise InputError(f"The mask {path} has {got} rows and columns, its image {want}. Export it again.")
    alpha = mask.int() * (255 if int(mask.max()) <= 1 else 1)
    if pixels.shape[2] == 4:
        alpha = (alpha * pixels[..., 3].int() + 127) // 255
    return torch.cat([pixels[..., :3], alpha.to(torch.uint8)[..., None]], dim=2)
