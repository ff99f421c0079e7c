"""A posed scene: views to learn from, views to judge by, and the points the poses came with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.cameras import Cameras
from gsopt.data.images import ImageStore


@dataclass(frozen=True)
class View:
    """One posed image. Pixels are read when asked for and cached by the store."""

    name: str
    """Path of the image relative to the scene, with forward slashes."""
    camera: Cameras
    """One camera, undistorted, at the working resolution."""
    store: ImageStore
    index: int
    """Its row in the store."""

    def pixels(self) -> UInt8[Tensor, "H W C"]:
        """sRGB-coded pixels, undistorted and downscaled; C = 4 (straight alpha) where there is alpha or a mask, else 3."""
        return self.store.get(self.index)


@dataclass(frozen=True)
class Points:
    """Sparse coloured points, usually from structure from motion."""

    xyz: Float[Tensor, "P 3"]
    rgb: UInt8[Tensor, "P 3"]


@dataclass(frozen=True)
class Scene:
    """Everything a run learns from. World frame as in the source."""

    path: Path
    kind: str
    """nerf-synthetic, nerfstudio or colmap."""
    train: tuple[View, ...]
    """Input views, after `--views` or `--view-ids` picked them."""
    test: tuple[View, ...]
    """Held-out views; empty when nothing was held out."""
    points: Points | None
    has_alpha: bool
    """True when every input view has alpha or a mask."""
    warnings: tuple[str, ...]
    """What the loader noticed (images absent, images skipped): shown to the user and kept with the run."""
