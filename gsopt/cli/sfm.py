"""`gsopt sfm`: from photos or a video to a posed scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from gsopt.cli.console import report
from gsopt.data.sfm.settings import SfmConfig


@dataclass(frozen=True)
class Flags:
    """Find where photos were taken from and write a scene that `gsopt train` and other tools read."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photos (of a posed scene with --poses prior), or a video."""
    config: OmitArgPrefixes[SfmConfig] = field(default_factory=SfmConfig)
    """Settings of the reconstruction."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="SCENE")] = None
    """Folder to write (images/, sparse/0/, transforms.json, points.ply, sfm.json, sfm.png); PHOTOS-posed in the
    folder one works in when not given."""


def main(argv: Sequence[str]) -> int:
    """Find the poses, print the diagnosis and return 0."""
    flags = tyro.cli(Flags, prog="gsopt sfm", args=list(argv))

    from gsopt.data.sfm.pipeline import OVERVIEW, pose_photos

    posed = pose_photos(flags.photos, flags.out or posed_name(flags.photos), flags.config, report)
    for line in posed.diagnosis.lines():
        print(line)
    print(f"{posed.path}: cameras and points in {OVERVIEW}; train with: gsopt train {posed.path}")
    return 0


def posed_name(photos: Path) -> Path:
    """Returns PHOTOS-posed."""
    return Path(f"{photos.expanduser().absolute().stem}-posed")
