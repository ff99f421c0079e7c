"""`gsopt render`: draw a finished run as images or a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from gsopt import check

if TYPE_CHECKING:
    from gsopt.geometry.cameras import Cameras

PATHS = ("train", "test", "orbit", "turntable", "ellipse", "interpolated")


@dataclass(frozen=True)
class Flags:
    """Draw a finished run along a camera path, as PNG frames or as a film."""

    run: tyro.conf.Positional[Path]
    """The run directory that `gsopt train` wrote."""
    path: str = "turntable"
    """train and test: those views; orbit and ellipse: around the subject; turntable: the orbit, or a swing where the
    cameras stood on one side only; interpolated: through the input views in their order; FILE.json: nerfstudio's
    camera path."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """A folder for PNG frames, a film that ends in .mp4, .webp or .gif, or a .json: the camera path, nothing drawn.
    RUN/frames/PATH when not given."""
    frames: int = 120
    """Frames on the other paths."""
    fps: float = 24.0
    """Frames per second of a film."""
    size: int | None = None
    """Scale the frames so that the longer side has this many pixels."""
    force: bool = False
    """Replace files that exist."""
    backend: Literal["auto", "cpu", "cuda", "mps", "reference"] | None = None
    """Draw with this backend instead of the run's."""
    threads: int | None = None
    """Draw with this many threads instead of the run's; 0 = one per core."""


def main(argv: Sequence[str]) -> int:
    """Draw, write, say where, and return 0."""
    flags = tyro.cli(Flags, prog="gsopt render", args=argv)
    check.within("--frames", flags.frames, 1, 100_000, "120 make five seconds.")
    if not flags.path.endswith(".json"):
        check.one_of("--path", flags.path, PATHS)
    if flags.size is not None:
        check.within("--size", flags.size, 1, 16384, "Drop the flag for the size of the input views.")

    from gsopt.events import refuse_links
    from gsopt.results.finished_run import cameras_along, open_run, render_stills, render_video
    from gsopt.results.measure import units_of
    from gsopt.results.video import VIDEO_SUFFIXES

    run = open_run(flags.run, flags.backend, flags.threads)
    shots = cameras_along(run, flags.path, flags.frames, flags.size)
    if flags.out is None:
        refuse_links(flags.run)
    output = flags.out or flags.run / "frames" / Path(flags.path).stem
    if output.suffix.lower() == ".json":
        write_path(output, [camera for _, camera in shots], flags, origin=units_of(flags.run).origin)
    elif output.suffix.lower() in VIDEO_SUFFIXES:
        render_video(run, shots, output, flags.fps, overwrite=flags.force)
    else:
        render_stills(run, shots, output, overwrite=flags.force)
    print(f"Written: {len(shots)} {'cameras' if output.suffix.lower() == '.json' else 'frames'} to {output}")
    return 0


def write_path(output: Path, cameras: list[Cameras], flags: Flags, origin: tuple[float, float, float]) -> None:
    """Write the cameras as nerfstudio's JSON; UsageError where a file is in the way."""
    from gsopt.results.camera_path_file import write_camera_path

    check.writable(output, flags.force)
    write_camera_path(output, cameras, flags.fps, origin)
