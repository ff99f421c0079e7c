"""Settings of a run: plain values, checked once. Equal settings are equal files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from gsopt import check
from gsopt.errors import UsageError

Layout = Literal["hemisphere", "sphere", "orbit", "spiral", "random", "file"]
Engine = Literal["cycles", "workbench"]
Lighting = Literal["studio", "flat", "hdri"]
Normalize = Literal["sphere", "cube"]
Format = Literal["nerf", "nerfstudio", "colmap"]

SPLITS = ("train", "test", "val")
PASSES = ("depth", "normals", "masks", "position")
ELEVATIONS: dict[str, tuple[float, float]] = {
    "hemisphere": (0.0, 80.0),
    "sphere": (-90.0, 90.0),
    "orbit": (20.0, 20.0),
    "spiral": (0.0, 80.0),
    "random": (-90.0, 90.0),
    "file": (-90.0, 90.0),
}
"""Lowest and highest elevation of a layout when none is given, degrees."""
BOUND = {"sphere": 1.0, "cube": 0.5 * math.sqrt(3.0)}
"""Radius of the sphere around the origin that a normalized object stays within."""
MARGIN = 0.96
"""Share of the frame that this sphere spans at the default distance."""
COLORS = {"white": (255, 255, 255), "black": (0, 0, 0), "gray": (128, 128, 128)}


@dataclass(frozen=True)
class Settings:
    """Views to render: their cameras, resolution and outputs."""

    views: int = 50
    """Input views."""
    test_views: int = 20
    """Held-out views, between the input views."""
    val_views: int = 0
    """Held-out views apart from the test views."""
    resolution: tuple[int, int] = (256, 256)
    """Width and height, px."""
    layout: Layout = "hemisphere"
    """hemisphere, sphere: Fibonacci points; orbit: one turn; spiral: three turns; random: uniform by area; file."""
    elevations: tuple[float, float] | None = None
    """Lowest and highest elevation, degrees; the layout's own when not given (`ELEVATIONS`)."""
    camera_file: str | None = None
    """With layout `file`: a transforms.json whose poses are taken; a frame may name its `split`."""
    radius: float | None = None
    """Distance of the cameras from the origin; by default the normalized object just fits the frame."""
    fov: float = 40.0
    """Horizontal field of view, degrees."""
    lens_jitter: float = 0.0
    """Each view's focal length varies by up to this share, its principal point by a quarter of it of the short side."""
    samples: int = 32
    """Light paths per pixel."""
    engine: Engine = "cycles"
    """cycles traces rays; workbench is a fast draft of the colors only."""
    lighting: Lighting = "studio"
    """studio: soft lamps fixed in the world; flat: bare surface colors; hdri: an environment image."""
    hdri: str | None = None
    """The environment image of `hdri` lighting."""
    background: str = "transparent"
    """transparent (straight alpha), white, black, gray or #rrggbb (no alpha)."""
    normalize: Normalize = "sphere"
    """The object fills the unit sphere, or the cube of side 1 around the origin."""
    depth: bool = False
    """depth/*.npy: float32 camera z at the pixel center, world units, 0 where there is nothing."""
    normals: bool = False
    """normal/*.npy: float16 world shading normals, facing the camera, 0 where there is nothing."""
    masks: bool = False
    """mask/*.png: 255 where the pixel center sees the object; alpha/*.png: share of the pixel that it covers."""
    position: bool = False
    """position/*.npy: float32 world position at the pixel center, 0 where there is nothing."""
    formats: tuple[Format, ...] = ("nerf",)
    """Formats of the cameras to write; they share the images."""
    points: int = 0
    """Colored surface samples, as points3d.ply and COLMAP points3D."""
    captions: bool = False
    """captions.json: a sentence for the object and one for every view."""
    preview: bool = False
    """preview.png: a contact sheet."""
    threads: int = 0
    """Threads of Cycles; 0 uses every core. The images do not depend on it."""

    def __post_init__(self) -> None:
        check.within("--views", self.views, 1, 2000, "100 is what NeRF-synthetic has.")
        check.within("--test-views", self.test_views, 0, 2000, "0 renders no test views.")
        check.within("--val-views", self.val_views, 0, 2000, "0 renders no validation views.")
        for side in self.resolution:
            check.within("--resolution", side, 8, 8192, "Give pixels: 256, or 320x240 for width and height.")
        check.one_of("--layout", self.layout, get_args(Layout))
        check.within("--fov", self.fov, 1.0, 150.0, "Give the horizontal field of view in degrees.")
        check.within("--lens-jitter", self.lens_jitter, 0.0, 0.5, "0.1 varies the focal length by 10 %.")
        check.within("--samples", self.samples, 1, 65_536, "16 is noisy but usable, 64 is clean.")
        check.one_of("--engine", self.engine, get_args(Engine))
        check.one_of("--lighting", self.lighting, get_args(Lighting))
        check.one_of("--normalize", self.normalize, get_args(Normalize))
        for name in self.formats:
            check.one_of("--format", name, get_args(Format))
        check.within("--points", self.points, 0, 10_000_000, "10000 is a good start for Gaussians.")
        check.within("--threads", self.threads, 0, 1024, "0 uses every core.")
        self._check_combinations()

    def _check_combinations(self) -> None:
        low, high = self.elevation_range
        if not -90.0 <= low <= high <= 90.0:
            raise UsageError(
                f"`--elevations` must be LOW <= HIGH within -90 to 90 degrees, got {low} {high}. Try -15 65."
            )
        if self.radius is not None:
            check.within("--radius", self.radius, 1.01 * self.bound, 1e4, "Stay outside of the object.")
        if self.engine == "workbench" and (asked := [p for p in (*PASSES, "points") if getattr(self, p)]):
            raise UsageError(f"`--engine workbench` draws colors only, got --{asked[0]} too. Use --engine cycles.")
        if (self.layout == "file") != (self.camera_file is not None):
            raise UsageError("`--layout file` and `--cameras FILE` go together, got one of them. Give both or neither.")
        if (self.lighting == "hdri") != (self.hdri is not None):
            raise UsageError("`--lighting hdri` needs its image, got none. Write --lighting hdri FILE.")
        if not self.formats or len(set(self.formats)) < len(self.formats):
            raise UsageError(f"`--format` must name each format once, got {','.join(self.formats)!r}. Try nerf,colmap.")
        _ = self.background_rgb

    @property
    def elevation_range(self) -> tuple[float, float]:
        """Lowest and highest elevation, degrees."""
        return self.elevations or ELEVATIONS[self.layout]

    @property
    def bound(self) -> float:
        """Radius around the origin that the normalized object stays within."""
        return BOUND[self.normalize]

    @property
    def focal(self) -> float:
        """Focal length without jitter, px."""
        return 0.5 * self.resolution[0] / math.tan(math.radians(0.5 * self.fov))

    @property
    def distance(self) -> float:
        """Distance of the cameras from the origin: `radius`, or the one at which the bound just fits the frame.

        The outline of a sphere of radius r seen from distance d has the tangent r / sqrt(d² - r²) to the axis.
        """
        if self.radius is not None:
            return self.radius
        half = 0.5 * min(self.resolution) * (1.0 - 0.5 * self.lens_jitter)
        tangent = MARGIN * half / (self.focal * (1.0 + self.lens_jitter))
        return self.bound * math.sqrt(1.0 + 1.0 / tangent**2)

    @property
    def background_rgb(self) -> tuple[int, int, int] | None:
        """sRGB-coded color behind the object, or None for transparent images. UsageError for an unknown name."""
        if self.background == "transparent":
            return None
        if re.fullmatch("#[0-9a-fA-F]{6}", self.background):
            red, green, blue = bytes.fromhex(self.background[1:])
            return red, green, blue
        check.one_of("--background", self.background, ("transparent", *COLORS, "#rrggbb"))
        return COLORS[self.background]

    @property
    def needs_depth(self) -> bool:
        return self.depth or self.masks or self.position or self.normals or self.points > 0

    def record(self) -> dict[str, Any]:
        """Returns the settings that decide the files: all but the number of threads, as JSON has it."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "threads"}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
