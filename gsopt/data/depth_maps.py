"""Depth maps beside the photos: measured ones, or a network's. Read once, checked, and kept small.

Kept is the inverse depth, NaN where it is unknown: a network's disparity is an affine function of it, and a
correlation with it needs neither scale nor shift. A map may be smaller than its photo, as networks write them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from gsopt.data import files
from gsopt.data.image_files import bomb
from gsopt.data.posed_images import summarize_names
from gsopt.data.undistort import Undistortion
from gsopt.errors import InputError

SUFFIXES = (".npy", ".png")
MAX_SIDE = 512
"""Longer side of what is kept, px: depth is smooth, and thousands of photos fit into memory."""
MAX_FILE_SIDE = 1 << 15
"""Longer side of a map that is read, px."""
ASPECT_TOLERANCE = 0.02
"""Largest relative difference of a map's aspect from its photo's: networks round their sizes."""
_REMEDY = "Export it again, or remove it."


@dataclass(frozen=True)
class DepthFolder:
    """The folder of `--depth`."""

    path: Path
    inverse: bool
    """True for maps of inverse depth."""

    def find(self, names: list[str]) -> list[Path | None]:
        """The map of each image, by its path below the dataset or by its file name where that is no other's.
        InputError for a folder that fits no image."""
        if not self.path.is_dir():
            raise InputError(f"`--depth` names no folder: got {self.path}. Give a folder of depth maps.")
        stems = [Path(name).stem for name in names]
        found = [
            self._map(Path(name).with_suffix("").as_posix()) or (self._map(stem) if stems.count(stem) == 1 else None)
            for name, stem in zip(names, stems, strict=True)
        ]
        if not any(found):
            raise InputError(
                f"The folder {self.path} has a depth map for none of the {len(names)} input images "
                f"({summarize_names(names[:1])}, ...). Name each map like its image, with .npy or .png at the end."
            )
        return found

    def _map(self, stem: str) -> Path | None:
        candidate = files.child(self.path, stem)
        if candidate.is_absolute() != self.path.is_absolute() or not candidate.is_relative_to(self.path):
            return None
        if ".." in candidate.parts:
            return None
        named = (candidate.with_name(candidate.name + suffix) for suffix in SUFFIXES)
        return next((path for path in named if files.is_regular(path)), None)

    def read(
        self, path: Path, stored: tuple[int, int], undistortion: Undistortion | None, size: tuple[int, int]
    ) -> Float[Tensor, "H W"]:
        """Inverse depths of a view of `size` (width, height) whose file has the size `stored`, NaN where unknown; no
        longer than MAX_SIDE. InputError for a file that holds no such map."""
        values = read_map(path)
        height, width = values.shape
        if abs(width * stored[1] / (height * stored[0]) - 1) > ASPECT_TOLERANCE:
            raise InputError(
                f"The depth map {path} is {width}x{height}, but its image is {stored[0]}x{stored[1]}: another aspect. "
                "Export it again for this image."
            )
        if not self.inverse and bool((values < 0).any()):
            raise InputError(
                f"The depth map {path} has negative distances. Are they inverse? Then give `--depth-kind inverse`."
            )
        if not bool((values != 0).any()):
            raise InputError(f"The depth map {path} is 0 everywhere: nothing is known. {_REMEDY}")
        unknown = torch.where(values == 0, torch.nan, values)
        inverse = unknown if self.inverse else 1 / unknown
        return _sampled(inverse, undistortion, size)


def read_map(path: Path) -> Float[Tensor, "H W"]:
    """The finite numbers of a depth map. InputError for anything else."""
    values = _read_array(path) if path.suffix == ".npy" else _read_png(path)
    if not bool(torch.isfinite(values).all()):
        raise InputError(f"The depth map {path} is not finite (NaN or infinity). Write 0 where the depth is unknown.")
    return values


def _read_array(path: Path) -> Float[Tensor, "H W"]:
    try:
        # A map takes no memory, and refuses a header that promises more than the file holds.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a hostile header raises nearly anything
        raise InputError(f"The depth map {path} is no array that NumPy reads safely: {error}. {_REMEDY}") from error
    shape = tuple(getattr(array, "shape", ()))
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fui" or not _is_map(shape):
        got = f"{getattr(array, 'dtype', 'no array')} {list(shape)}"
        raise InputError(f"The depth map {path} must hold numbers of shape [H, W], got {got}. {_REMEDY}")
    return torch.from_numpy(np.array(array, dtype=np.float32))


def _is_map(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and min(shape) > 0 and max(shape) <= MAX_FILE_SIDE


def _read_png(path: Path) -> Float[Tensor, "H W"]:
    try:
        with Image.open(path, formats=("PNG",)) as image:
            if reason := bomb(image, path):
                raise ValueError(f"it declares {reason}")
            if not image.mode.startswith("I"):
                raise ValueError(f"its mode is {image.mode}; a gray image of 16 bits is read")
            return torch.from_numpy(np.array(image, dtype=np.float32))
    except Exception as error:  # decoders raise nearly anything on a hostile file
        raise InputError(f"Cannot read the depth map {path}: {error}. {_REMEDY}") from error


def _sampled(
    values: Float[Tensor, "h w"], undistortion: Undistortion | None, size: tuple[int, int]
) -> Float[Tensor, "H W"]:
    """The map as the undistorted view sees it, from the nearest sample: no depth between two surfaces is made up."""
    scale = min(1.0, MAX_SIDE / max(size))
    width, height = (max(1, round(extent * scale)) for extent in size)
    if undistortion is None:
        return torch.nn.functional.interpolate(values[None, None], (height, width), mode="nearest-exact")[0, 0]
    grid = undistortion.sample_grid().permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(grid, (height, width), mode="area")[0].permute(1, 2, 0)
    sampled = torch.nn.functional.grid_sample(
        values[None, None], small[None], mode="nearest", padding_mode="border", align_corners=False
    )
    return sampled[0, 0]
