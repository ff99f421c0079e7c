"""A posed scene: input views, held-out views, and the points the poses came with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.config.train import DataConfig
from gsopt.data import files
from gsopt.data.colmap import find_model, read_colmap
from gsopt.data.depth_maps import DepthFolder
from gsopt.data.idr import CAMERAS, read_idr
from gsopt.data.images import ImageSource, ImageStore, check_mask_size, read_header, size_mismatch
from gsopt.data.llff import POSES, read_llff
from gsopt.data.masks import unmasked_warning, with_masks
from gsopt.data.posed_images import Dataset, PosedImage, summarize_names
from gsopt.data.resample import downscaled_size
from gsopt.data.split import split
from gsopt.data.transforms import read_transforms
from gsopt.data.undistort import Undistortion, choose_pinhole
from gsopt.errors import InputError, UsageError
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.voxels import Grid
from gsopt.raster.threads import preparing_threads

FAR_FROM_ORIGIN = 1e3
"""Scenes farther from the origin than this many extents are moved there: float32 would lose their detail."""
MAX_COORDINATE = 1e18
"""Its square is finite in float32."""
LONGEST_SIDE = 1600
"""Longer side of a photo beyond which it is reduced where no divisor is given, px (as in Kerbl et al. 2023)."""
LEAST_SIDE = 16
"""Shorter side below which no divisor may take an image, px: somebody gave the size that they want."""
FARTHEST_POINT = 1e6
"""Points farther from their median than this many median distances are left out: in float32 they overflow, or all
others fall on one place."""


class PixelStore(Protocol):
    """The images of views, by row."""

    def get(self, index: int) -> UInt8[Tensor, "H W C"]: ...


@dataclass(frozen=True)
class View:
    """One posed image. Its pixels are read on demand and cached by the store."""

    name: str
    """Path of the image relative to the scene, with forward slashes."""
    camera: Cameras
    """One camera, undistorted, at the working resolution."""
    store: PixelStore
    index: int
    """Its row in the store."""
    mirrored: bool = False
    """Read from right to left: not a photo but the mirror image of one (gsopt/symmetry)."""
    color: float = 1.0
    """Weight of its colors in the loss; at 0 only its silhouette counts."""
    depth: Float[Tensor, "h w"] | None = None
    """Inverse depths of any scale and shift, NaN where unknown, at their own resolution; see `--depth`."""

    def pixels(self) -> UInt8[Tensor, "H W C"]:
        """sRGB-coded pixels, undistorted and downscaled; C = 4 (straight alpha) with alpha or a mask, else 3."""
        stored = self.store.get(self.index)
        return stored.flip(1) if self.mirrored else stored

    def inverse_depths(self, height: int, width: int) -> Float[Tensor, "H W"] | None:
        """Returns the depth map at a size, by the nearest sample, or None without one."""
        if self.depth is None:
            return None
        sized = torch.nn.functional.interpolate(self.depth[None, None], (height, width), mode="nearest-exact")[0, 0]
        return sized.flip(1) if self.mirrored else sized


@dataclass(frozen=True)
class Points:
    """Sparse colored points, usually from structure from motion."""

    xyz: Float[Tensor, "P 3"]
    rgb: UInt8[Tensor, "P 3"]


@dataclass(frozen=True)
class AgreedPoints:
    """Places on which at least two photos agree, and their colors."""

    xyz: Float[Tensor, "N 3"]
    rgb: Float[Tensor, "N 3"]
    """0..1."""
    photos: int
    """Number of photos that were matched."""
    share: float
    """Share of their pixels on which another photo agrees."""


@dataclass(frozen=True)
class Scene:
    """All input data of a run. World frame as in the source, less `origin`."""

    path: Path
    kind: str
    """nerf-synthetic, nerfstudio, colmap, llff or idr."""
    train: tuple[View, ...]
    """Input views, after `--views` or `--view-ids` picked them."""
    test: tuple[View, ...]
    """Held-out views; empty when nothing was held out."""
    points: Points | None
    has_alpha: bool
    """True when every input view has alpha or a mask."""
    warnings: tuple[str, ...]
    """Irregularities in the dataset (images absent, images skipped): printed and kept with the run."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from every source position; not zero only where coordinates were too large for float32."""
    mirrored: tuple[View, ...] = ()
    """Images of the input views behind mirrors or turned about an axis, where the object is symmetric."""
    guessed: tuple[View, ...] = ()
    """Views of the shape that a single photo, or up to three with a shape prior, suggest (gsopt/init/inflation.py)."""
    body: Grid | None = None
    """This shape, where something else than inflation found it (gsopt/shape_library, gsopt/shape_prior)."""
    body_colors: Float[Tensor, "X Y Z 3"] | None = None
    """Colors of its voxels (0..1) for the sides that no photo shows; without them the photo's go straight through."""
    agreed: AgreedPoints | None = None
    """Places on which the input views agree, once they were matched (gsopt/init/stereo)."""

    @property
    def observed(self) -> tuple[View, ...]:
        """The views that count as evidence: the input views, then their mirror images."""
        return self.train + self.mirrored

    @property
    def drawn(self) -> tuple[View, ...]:
        """The views a training step draws from: those that count as evidence, then guesses."""
        return self.observed + self.guessed

    @property
    def completed(self) -> bool:
        """True when the photos are completed by images that nobody took: one by any, several by guesses."""
        return len(self.guessed) > 0 or (len(self.train) == 1 and len(self.drawn) > 1)

    @property
    def extent(self) -> float:
        """1.1 times the farthest input camera's distance from their mean (Kerbl et al. 2023), scene units.

        For cameras in one place it is their mean distance to the points, else 1.
        """
        centers = torch.cat([view.camera.centers for view in self.train])
        radius = 1.1 * float((centers - centers.mean(0)).norm(dim=1).max())
        if radius > 1e-6:
            return radius
        if self.points is None or len(self.points.xyz) == 0:
            return 1.0
        return max(float((self.points.xyz - centers.mean(0)).norm(dim=1).mean()), 1e-6)


def read_ahead(views: Sequence[View]) -> None:
    """Decode images side by side; the store keeps those that fit. InputError for the first that cannot be decoded."""

    def read(view: View) -> None:
        view.pixels()

    with ThreadPoolExecutor(preparing_threads()) as pool:
        for _ in pool.map(read, views):
            pass


def load_scene(config: DataConfig | str | Path) -> Scene:
    """Read a folder with a COLMAP model or one of the files in READERS; a path stands for `DataConfig(path=...)`.

    Images are opened for their size only; pixels are read on demand. Raises InputError for anything wrong with
    the folder and UsageError for `--views` and `--view-ids` that do not fit it.
    """
    if not isinstance(config, DataConfig):
        config = DataConfig(path=str(config))
    root = Path(config.path).expanduser()
    dataset = with_masks(read_dataset(root), root, config.masks)
    if not dataset.frames:
        raise InputError(f"{root} has no input view whose image exists. Restore the images, or give another folder.")
    train, test = split(dataset, config)
    if not train:
        raise InputError(f"{root} has no input view left after the test views were held out. Add images.")
    warnings = [*dataset.warnings, *unmasked_warning(train + test, root, config.masks)]
    origin = _origin(dataset.frames + (dataset.held_out or []), warnings)  # the same whichever views are chosen
    depths = _depth_files(train, config, warnings)  # held-out views need none
    views, has_alpha = _views(root, train + test, depths, origin, config)
    longest = max(max(frame.width, frame.height) for frame in train)
    if config.downscale is None and longest > LONGEST_SIDE:
        warnings.append(
            f"Photos of up to {longest:,} px are learned at {LONGEST_SIDE:,} px: `--resolution 1` keeps all pixels."
        )
    return Scene(
        path=root,
        kind=dataset.kind,
        train=views[: len(train)],
        test=views[len(train) :],
        points=_points(dataset, origin, warnings),
        has_alpha=all(has_alpha[: len(train)]),
        warnings=tuple(warnings),
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
    )


READERS = {
    "transforms_train.json": read_transforms,
    "transforms.json": read_transforms,
    POSES: read_llff,
    CAMERAS: read_idr,
}
"""Readers by the file that recognizes a dataset, in order; a COLMAP model comes before all."""


def is_posed(root: Path) -> bool:
    """True when a folder holds a dataset with poses, by the names of its files."""
    return find_model(root) is not None or any(files.is_regular(root / name) for name in READERS)


def read_dataset(root: Path) -> Dataset:
    """The dataset in a folder, before anything is chosen. InputError where there is none."""
    if not root.is_dir():
        raise InputError(
            f"The dataset folder {root} does not exist or is no folder. Give the folder that holds the images."
        )
    if find_model(root) is not None:
        return read_colmap(root)
    for name, read in READERS.items():
        if files.is_regular(root / name):
            return read(root)
    raise InputError(
        f"{root} holds no posed dataset. Looked for sparse/0 or sparse with cameras, images and points3D as .bin or "
        f".txt (COLMAP), transforms_train.json (NeRF-synthetic), transforms.json (nerfstudio, instant-ngp), {POSES} "
        f"(LLFF) and {CAMERAS} (IDR, NeuS). Photos alone have no poses yet: find them with `gsopt sfm`."
    )


def _origin(frames: list[PosedImage], warnings: list[str]) -> Float[Tensor, "3"]:
    """Zero, or the rounded mean camera center when the scene lies too far out for float32."""
    centers = torch.stack([-frame.viewmat[:3, :3].T @ frame.viewmat[:3, 3] for frame in frames])
    mean = centers.mean(0)
    extent = 1.1 * float((centers - mean).norm(dim=1).max())
    if float(mean.norm()) <= FAR_FROM_ORIGIN * (extent if extent > 1e-6 else 1.0):
        return torch.zeros(3, dtype=torch.float64)
    origin = mean.round() if extent > 1 else mean
    moved = ", ".join(f"{value:.10g}" for value in origin.tolist())
    warnings.append(
        f"The cameras lie {float(mean.norm()):.4g} units from the origin but only {extent:.4g} apart: "
        f"({moved}) is subtracted from every position, because 32-bit numbers would lose the detail."
    )
    return origin


def _depth_files(train: list[PosedImage], config: DataConfig, warnings: list[str]) -> list[Path | None]:
    """The depth map of each input view; a warning for those without."""
    if config.depth is None:
        return []
    found = DepthFolder(Path(config.depth).expanduser(), config.depth_kind == "inverse").find([f.name for f in train])
    if lacking := [frame.name for frame, path in zip(train, found, strict=True) if path is None]:
        warnings.append(
            f"{config.depth} has no depth map for {len(lacking)} of {len(train)} input images: "
            f"{summarize_names(lacking)}."
        )
    return found


def _views(
    root: Path, frames: list[PosedImage], depths: list[Path | None], origin: Tensor, config: DataConfig
) -> tuple[tuple[View, ...], list[bool]]:
    """Views that share one store, and per view True when it has alpha. `depths`: those of the first frames."""
    pinholes: dict[tuple[object, ...], Undistortion] = {}
    prepared = [_prepare(root, frame, config.downscale, pinholes) for frame in frames]
    store = ImageStore([image for image, _, _ in prepared], config.cache_mb)
    views = [
        View(frame.name, _camera(frame, K, origin, image), store, index)
        for index, (frame, (image, K, _)) in enumerate(zip(frames, prepared, strict=True))
    ]
    folder = DepthFolder(Path(config.depth or ""), config.depth_kind == "inverse")
    for index, path in enumerate(depths):
        if path is not None:
            image = prepared[index][0]
            depth = folder.read(path, image.stored, image.undistortion, (image.width, image.height))
            views[index] = replace(views[index], depth=depth)
    return tuple(views), [alpha for _, _, alpha in prepared]


def _prepare(
    root: Path, frame: PosedImage, divisor: int | None, pinholes: dict[tuple[object, ...], Undistortion]
) -> tuple[ImageSource, Tensor, bool]:
    """The source of the frame's pixels, the pinhole K at working size, and True when there is alpha."""
    path, stored = _stored_image(root, frame, divisor or 1)
    factor = divisor or max(1.0, max(frame.width, frame.height) / LONGEST_SIDE)
    width, height = (downscaled_size(extent, factor) for extent in (frame.width, frame.height))
    if divisor and min(width, height) < LEAST_SIDE <= min(frame.width, frame.height) / 4:
        raise UsageError(
            f"`--resolution` divides width and height: {factor} leaves {width} x {height} px of {frame.name}, "
            f"{frame.width} x {frame.height} px. Give 2 for half the size, 4 for a quarter."
        )
    K, undistortion = _resized(frame.K, (frame.width, frame.height), stored), None
    if not frame.lens.is_pinhole:
        key = (frame.lens, tuple(K.flatten().tolist()), stored)
        if key not in pinholes:
            pinholes[key] = choose_pinhole(frame.lens, K, *stored, where=str(frame.path))
        undistortion = pinholes[key]
        K = undistortion.pinhole
    if path != frame.path:
        width, height = stored
    if frame.mask is not None:
        check_mask_size(frame.mask, read_header(frame.mask)[:2], stored)
    image = ImageSource(path, frame.mask, stored, undistortion, width, height)
    alpha = frame.mask is not None or read_header(path)[2]
    return image, _resized(K, stored, (width, height)), alpha


def _stored_image(root: Path, frame: PosedImage, factor: int) -> tuple[Path, tuple[int, int]]:
    """The file to read and its size: images_N/ when there is one for `factor`, else the frame's own."""
    declared = (frame.width, frame.height)
    name = Path(frame.name)
    if factor > 1 and not name.is_absolute() and name.parts[0] == "images":
        smaller = root.joinpath(f"images_{factor}", *name.parts[1:])
        if files.is_regular(smaller):
            width, height, _ = read_header(smaller)
            # Published folders round up, down or to nearest.
            if abs(width - declared[0] / factor) >= 1 or abs(height - declared[1] / factor) >= 1:
                raise size_mismatch(smaller, (width, height), (frame.width // factor, frame.height // factor))
            return smaller, (width, height)
    width, height, _ = read_header(frame.path)
    if (width, height) != declared:
        raise size_mismatch(frame.path, (width, height), declared)
    return frame.path, declared


def _resized(K: Tensor, old: tuple[int, int], new: tuple[int, int]) -> Tensor:
    """K for the same view at another size, by the true ratio of the two sizes."""
    return K * torch.tensor([new[0] / old[0], new[1] / old[1], 1.0], dtype=K.dtype)[:, None]


def _camera(frame: PosedImage, K: Tensor, origin: Tensor, image: ImageSource) -> Cameras:
    viewmat = frame.viewmat.clone()
    viewmat[:3, 3] += viewmat[:3, :3] @ origin  # x_cam = R (x' + origin) + t
    camera = Cameras(viewmat[None].float(), K[None].float(), image.width, image.height)
    return camera.validate()


def _points(dataset: Dataset, origin: Tensor, warnings: list[str]) -> Points | None:
    if dataset.xyz is None or dataset.rgb is None or len(dataset.xyz) == 0:
        return None
    xyz = dataset.xyz - origin
    distances = (xyz - xyz.median(0).values).norm(dim=1)
    near = distances <= min(FARTHEST_POINT * float(distances.median()) or math.inf, MAX_COORDINATE)
    if not bool(near.all()):
        warnings.append(
            f"{int((~near).sum()):,} of {len(xyz):,} points lie more than {FARTHEST_POINT:,.0f} times as far out as "
            "half of them and are left out."
        )
    return Points(xyz[near].float(), dataset.rgb[near])
