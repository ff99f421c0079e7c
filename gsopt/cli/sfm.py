"""`gsopt sfm`: from photos or a video to a posed scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, Positional, arg

from gsopt.data.sfm.settings import SfmConfig


def sfm(
    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")],
    config: OmitArgPrefixes[SfmConfig],
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="SCENE")] = None,
) -> int:
    """Find where photos were taken from and write a scene that `gsopt train` and other tools read.

    Args:
        photos: Folder of photos (of a posed scene with --poses prior), or a video.
        config: How.
        out: Folder to write (images/, sparse/0/, transforms.json, points.ply, sfm.json, sfm.png); PHOTOS-posed in the
            folder one works in when not given.
    """
    from gsopt.data.sfm.pipeline import PICTURE, pose_photos

    posed = pose_photos(photos, out or posed_name(photos), config, report=say)
    for line in posed.diagnosis.lines():
        print(line)
    print(f"{posed.path}: cameras and points in {PICTURE}; train with: gsopt train {posed.path}")
    return 0


def posed_name(photos: Path) -> Path:
    """PHOTOS-posed."""
    return Path(f"{photos.expanduser().absolute().stem}-posed")


def say(line: str) -> None:
    """One line of progress, at once also where stdout is a pipe."""
    print(line, flush=True)


def main(argv: Sequence[str]) -> int:
    """Parse the arguments after `gsopt sfm` and run it; the exit code."""
    return tyro.cli(sfm, args=list(argv), prog="gsopt sfm")
