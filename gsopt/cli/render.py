"""`gsopt render`: draw a finished run as images or a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gsopt import check


@dataclass(frozen=True)
class Flags:
    """Draw a finished run along a camera path, as PNG frames or as a film."""

    run: tyro.conf.Positional[Path]
    """The run directory that `gsopt train` wrote."""
    path: Literal["train", "test", "orbit", "turntable", "ellipse", "interpolated"] = "turntable"
    """train and test: those views; orbit and ellipse: around the subject; turntable: the orbit, or a swing where the
    cameras stood on one side only; interpolated: through the input views in their order."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A folder for PNG frames, or a film that ends in .mp4, .webp or .gif. RUN/frames/PATH when not given."""
    frames: int = 120
    """Frames on the other paths."""
    fps: float = 24.0
    """Frames per second of a film."""
    size: int | None = None
    """Scale the frames so that the longer side has this many pixels."""
    overwrite: bool = False
    """Replace files that exist."""
    backend: Literal["auto", "cpu", "cuda", "reference"] | None = None
    """Draw with this backend instead of the run's."""
    threads: int | None = None
    """Draw with this many threads instead of the run's; 0 = one per core."""


def main(argv: Sequence[str]) -> int:
    """Draw, write, say where, and return 0."""
    flags = tyro.cli(Flags, prog="gsopt render", args=argv)
    check.within("--frames", flags.frames, 1, 100_000, "120 make five seconds.")
    if flags.size is not None:
        check.within("--size", flags.size, 1, 16384, "Drop the flag for the size of the input views.")

    from gsopt.events import refuse_links
    from gsopt.results.finished_run import cameras_along, open_run, render_stills, render_video
    from gsopt.results.video import VIDEO_SUFFIXES

    run = open_run(flags.run, flags.backend, flags.threads)
    shots = cameras_along(run, flags.path, flags.frames, flags.size)
    if flags.output is None:
        refuse_links(flags.run)
    output = flags.output or flags.run / "frames" / flags.path
    if output.suffix.lower() in VIDEO_SUFFIXES:
        render_video(run, shots, output, flags.fps, overwrite=flags.overwrite)
    else:
        render_stills(run, shots, output, overwrite=flags.overwrite)
    print(f"Written: {len(shots)} frames to {output}")
    return 0
