"""Masks for feature extraction: those of a folder, or the photos' own alpha."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.images import read_gray
from gsopt.data.masks import FOLDER, find_mask
from gsopt.data.sfm.photos import Photo
from gsopt.errors import InputError

OPAQUE_BACKGROUND = (128, 128, 128)
"""Replaces the colors of transparent pixels, which are arbitrary and would give features."""


@dataclass(frozen=True)
class FeatureInput:
    """Photos and masks for feature extraction."""

    photos: Path
    """Folder of opaque photos."""
    masks: Path | None
    """Folder of NAME.png, white for features; absent if every pixel counts."""
    kind: str
    """folder, alpha or none, with `auto` resolved."""
    unmasked: list[str]
    """Photos for which the folder holds no mask."""


def prepare_masks(choice: str, source: Path, photos: list[Photo], work: Path) -> FeatureInput:
    """Write the masks and opaque copies that `--masks` selects into `work`. InputError where none fits."""
    folder = mask_folder(choice, source)
    has_alpha = any(photo.has_alpha for photo in photos)
    if folder is not None:
        kind, unmasked = "folder", _from_folder(folder, photos, work / "masks")
    elif choice == "alpha" or (choice == "auto" and has_alpha):
        kind, unmasked = "alpha", _from_alpha(photos, work / "masks")
    elif choice in ("auto", "none"):
        kind, unmasked = "none", []
    else:
        raise InputError(f"`--masks` names no folder: got {choice}. Give a folder of masks, alpha or none.")
    opaque = _opaque(photos, work / "opaque") if has_alpha else work / "photos"
    return FeatureInput(opaque, None if kind == "none" else work / "masks", kind, unmasked)


def mask_folder(choice: str, source: Path) -> Path | None:
    """The folder of masks that `--masks` selects, if it is there."""
    folder = source / FOLDER if choice == "auto" else Path(choice).expanduser()
    return folder if choice not in ("alpha", "none") and folder.is_dir() else None


def _from_folder(folder: Path, photos: list[Photo], target: Path) -> list[str]:
    """Copies the masks of all photos; returns the photos without one."""
    target.mkdir()
    unmasked: list[str] = []
    for photo in photos:
        mask = find_mask(folder, photo.source.name)
        if mask is None:
            unmasked.append(photo.name)
            continue
        gray = read_gray(mask, (photo.width, photo.height)).numpy()
        gray = gray * (255 if gray.max() <= 1 else 1)
        Image.fromarray(gray.astype(np.uint8)).save(target / f"{photo.name}.png", compress_level=1)
    if len(unmasked) == len(photos):
        raise InputError(
            f"The folder {folder} has a mask for none of the {len(photos)} photos. Name them like the photos, with "
            ".png at the end, or give `--masks none`."
        )
    return unmasked


def _from_alpha(photos: list[Photo], target: Path) -> list[str]:
    """The alpha of all photos as masks; returns the photos without alpha."""
    target.mkdir()
    if not any(photo.has_alpha for photo in photos):
        raise InputError(
            f"`--masks alpha` needs photos with transparency, got {len(photos)} without. Give a folder of masks."
        )
    for photo in photos:
        if photo.has_alpha:
            with Image.open(photo.path, formats=IMAGE_FORMATS) as image:
                image.convert("RGBA").getchannel("A").save(target / f"{photo.name}.png", compress_level=1)
    return [photo.name for photo in photos if not photo.has_alpha]


def _opaque(photos: list[Photo], target: Path) -> Path:
    """Copies without alpha, on gray."""
    target.mkdir()
    for photo in photos:
        if not photo.has_alpha:
            (target / photo.name).symlink_to(photo.path.resolve())
            continue
        with Image.open(photo.path, formats=IMAGE_FORMATS) as image:
            layered = image.convert("RGBA")
            behind = Image.new("RGBA", layered.size, (*OPAQUE_BACKGROUND, 255))
            Image.alpha_composite(behind, layered).convert("RGB").save(target / photo.name, compress_level=1)
    return target
