"""Masks: black hides a pixel (alpha 0), white shows it; gray levels are partial alpha."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import UInt8
from torch import Tensor

from gsopt.data import files
from gsopt.data.posed_images import Dataset, PosedImage, summarize_names
from gsopt.errors import InputError, UsageError

FOLDER = "masks"
"""The folder of a dataset's own masks."""
MaskChoice = Callable[[list[PosedImage]], list[Path | None]]
MASK_SUFFIXES = (".png", ".PNG", ".jpg", ".jpeg", ".JPG", ".JPEG", ".webp")


def with_masks(dataset: Dataset, root: Path, choice: str = "given") -> Dataset:
    """The dataset with the masks that `--masks` chooses: its own (given), those of a folder, or no mask files (none).
    InputError for a folder that fits no image."""
    if choice == "none":
        return _masked(dataset, lambda frames: [None] * len(frames))
    if choice == "auto":
        raise UsageError("`--masks auto` is for `gsopt train` and reconstruct(), got it here. Run `gsopt masks` first.")
    if choice != "given":
        return _with_folder(dataset, Path(choice).expanduser())
    folder = root / FOLDER
    if not folder.is_dir():
        return dataset
    return _masked(dataset, lambda frames: _own_first(frames, folder))


def _with_folder(dataset: Dataset, folder: Path) -> Dataset:
    if not folder.is_dir():
        raise InputError(f"`--masks` names no folder: got {folder}. Give a folder of masks, given, auto or none.")
    masked = _masked(dataset, lambda frames: find_masks(folder, [frame.name for frame in frames]))
    frames = [*masked.frames, *(masked.held_out or [])]
    if not any(frame.mask for frame in frames):
        raise InputError(
            f"The folder {folder} has a mask for none of the {len(frames)} images ({summarize_names([frames[0].name])}"
            ", ...). Name each mask like its image, with .png at the end."
        )
    return masked


def _own_first(frames: list[PosedImage], folder: Path) -> list[Path | None]:
    """The mask that the dataset names for a frame, else that of the folder."""
    found = find_masks(folder, [frame.name for frame in frames])
    return [frame.mask or mask for frame, mask in zip(frames, found, strict=True)]


def _masked(dataset: Dataset, choose: MaskChoice) -> Dataset:
    """The dataset with the masks that a function of all its frames returns."""
    held_out = dataset.held_out or []
    frames = [*dataset.frames, *held_out]
    masked = [replace(frame, mask=mask) for frame, mask in zip(frames, choose(frames), strict=True)]
    count = len(dataset.frames)
    return replace(dataset, frames=masked[:count], held_out=None if dataset.held_out is None else masked[count:])


def unmasked_warning(frames: list[PosedImage], root: Path, choice: str) -> list[str]:
    """A warning that names the images without a mask, where there is a folder of masks."""
    folder = root / FOLDER if choice == "given" else Path(choice).expanduser()
    unmasked = [frame.name for frame in frames if frame.mask is None]
    if choice == "none" or not folder.is_dir() or not unmasked:
        return []
    return [f"{folder.name}/ has no mask for {len(unmasked)} of {len(frames)} images: {summarize_names(unmasked)}."]


def find_masks(folder: Path, names: Sequence[str]) -> list[Path | None]:
    """The mask of each image by its path below the dataset (train/r_0.png), below its first folder, or by its file
    name; the shorter ones only where they are no other image's too."""
    ways = [names, [_tail(name) for name in names], [PurePosixPath(name).name for name in names]]
    counts = [Counter(PurePosixPath(name).with_suffix("").as_posix() for name in way) for way in ways]
    masks = []
    for tried in zip(*ways, strict=True):
        stems = [PurePosixPath(name).with_suffix("").as_posix() for name in tried]
        own = [name for name, stem, count in zip(tried, stems, counts, strict=True) if count[stem] == 1]
        found = (find_mask(folder, name) for name in own)
        masks.append(next((mask for mask in found if mask is not None), None))
    return masks


def _tail(name: str) -> str:
    """A path without its first folder."""
    parts = PurePosixPath(name).parts
    return "/".join(parts[1:]) if len(parts) > 1 else name


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of image `name` (relative to its image folder): `name.ext.png` as COLMAP writes it, or `name.png`."""
    image = files.child(folder, name)
    if image.is_absolute() != folder.is_absolute() or ".." in image.parts or not image.is_relative_to(folder):
        image = folder / image.name  # the image lies elsewhere: never take it for its own mask
    same_stem = (image.with_suffix(suffix) for suffix in MASK_SUFFIXES)
    for candidate in (image.with_name(image.name + ".png"), *same_stem):
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
