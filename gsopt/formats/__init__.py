"""Splat files: one reader and one writer, which choose the format by the file's suffix.

| suffix | format | loss |
|---|---|---|
| `.ply` | Inria PLY | none |
| `.compressed.ply` | PlayCanvas compressed PLY | quantized in chunks of 256 |
| `.splat` | antimatter15 | no view-dependent color, 8-bit color and rotation |
| `.spz` | Niantic SPZ | 24-bit position, 8-bit rest |
| `.sog` | PlayCanvas SOG bundle | 16-bit position, 256 scales and colors, a palette of harmonics |
| `.glb` | glTF, KHR_gaussian_splatting (release candidate) | rounding of exp and sigmoid |
| `.usda`, `.usdc` | OpenUSD's ParticleField, with usd-core | rounding of exp and sigmoid |
| `.ksplat` | mkkellogg's; is read only | |
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from gsopt.errors import InputError
from gsopt.formats.units import UNKNOWN, Units

if TYPE_CHECKING:
    from gsopt.gaussians import Gaussians

SUFFIXES = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".usda", ".usdc")
READABLE = (*SUFFIXES, ".ksplat")


def suffix_of(path: Path, known: tuple[str, ...] = SUFFIXES) -> str:
    """The one of `known` that names the format of `path`, or InputError listing them."""
    name = path.name.lower()
    for suffix in sorted(known, key=len, reverse=True):
        if name.endswith(suffix):
            return suffix
    raise InputError(f"{path} must end in one of {', '.join(known)}, got {path.suffix!r}. Rename it or choose one.")


def save_splats(
    path: str | PathLike[str], gaussians: Gaussians, *, antialiased: bool = False, units: Units = UNKNOWN
) -> None:
    """Write `gaussians` in the format that the suffix of `path` names; whole file or nothing.

    `antialiased`: the splats were optimized with the 2D filter of Mip-Splatting; recorded by formats that can (.ply,
    .spz, .sog). `units`: scale and origin, which .ply, .compressed.ply, .sog, .glb, .usda and
    .usdc carry. Raises InputError for a
    row that is not finite, a rotation of length zero, a full disk or an unknown suffix.
    """
    path = Path(path)
    match suffix_of(path):
        case ".ply":
            from gsopt.formats.ply import save_ply

            save_ply(path, gaussians, antialiased=antialiased, units=units)
        case ".compressed.ply":
            from gsopt.formats.compressed_ply import save_compressed_ply

            save_compressed_ply(path, gaussians, units=units)
        case ".splat":
            from gsopt.formats.splat import save_splat

            save_splat(path, gaussians)
        case ".spz":
            from gsopt.formats.spz import save_spz

            save_spz(path, gaussians, antialiased=antialiased)
        case ".sog":
            from gsopt.formats.sog import save_sog

            save_sog(path, gaussians, antialiased=antialiased, units=units)
        case ".glb":
            from gsopt.formats.gltf import save_glb

            save_glb(path, gaussians, units=units)
        case ".usda" | ".usdc":
            from gsopt.formats.usd import save_usd

            save_usd(path, gaussians, units=units)


def load_splats(path: str | PathLike[str], *, strict: bool = False) -> Gaussians:
    """Read splats in the format that the suffix of `path` names; float32 on the CPU, every value finite.

    The file is not trusted: its header is checked against its size before memory is allocated. Infinite logits of
    opacities become ±6.9; splats with other values that are not finite, or with a rotation of no length, are left out
    and counted in one InputWarning. `strict` refuses them. Raises InputError for any other defect.
    """
    from gsopt.formats.validation import checked, usable

    path = Path(path)
    gaussians = _read(path)
    return checked(gaussians, path) if strict else usable(gaussians, path)


def _read(path: Path) -> Gaussians:
    """The splats of a file as they stand there, not yet checked."""
    match suffix_of(path, READABLE):
        case ".splat":
            from gsopt.formats.splat import load_splat

            return load_splat(path)
        case ".spz":
            from gsopt.formats.spz import load_spz

            return load_spz(path)
        case ".sog":
            from gsopt.formats.sog import load_sog

            return load_sog(path)
        case ".ksplat":
            from gsopt.formats.ksplat import load_ksplat

            return load_ksplat(path)
        case ".glb":
            from gsopt.formats.gltf import load_glb

            return load_glb(path)
        case ".usda" | ".usdc":
            from gsopt.formats.usd import load_usd

            return load_usd(path)
        case _:
            from gsopt.formats.compressed_ply import load_any_ply

            return load_any_ply(path)


def is_antialiased(path: str | PathLike[str]) -> bool:
    """True when a file records that its splats need the 2D filter of Mip-Splatting; some formats cannot record it."""
    path = Path(path)
    match suffix_of(path, READABLE):
        case ".ply":
            from gsopt.formats.ply import ply_antialiased

            return ply_antialiased(path)
        case ".spz":
            from gsopt.formats.spz import spz_antialiased

            return spz_antialiased(path)
        case ".sog":
            from gsopt.formats.sog import sog_antialiased

            return sog_antialiased(path)
        case _:
            return False
