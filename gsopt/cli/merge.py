"""`gsopt merge`: the splats of two runs of one object in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gsopt import check
from gsopt.formats import SUFFIXES, suffix_of

if TYPE_CHECKING:
    from gsopt.gaussians import Gaussians
    from gsopt.results.finished_run import FinishedRun

MEASURED_VIEWS = 24


@dataclass(frozen=True)
class Flags:
    """Write the splats of two runs of one object as one file, in the first's frame. They share three or more photos."""

    first: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """A run directory that `gsopt train` wrote."""
    second: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Another one; it may stand, be turned and scaled otherwise."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write; its ending chooses the format, as in `gsopt export`."""
    force: bool = False
    """Replace OUT if it exists."""


def main(argv: Sequence[str]) -> int:
    """Merge, print what was found and what it changes, and return 0."""
    flags = tyro.cli(Flags, prog="gsopt merge", args=list(argv))
    suffix_of(flags.out, SUFFIXES)
    check.writable(flags.out, flags.force)

    from gsopt.formats import save_splats
    from gsopt.results.finished_run import open_run
    from gsopt.results.measure import units_of
    from gsopt.results.merge import merge, turned_degrees

    runs = [open_run(flags.first), open_run(flags.second)]
    merged = merge(*runs)
    found = merged.alignment
    turn, scale = turned_degrees(found.similarity), found.similarity.scale
    print(
        f"{flags.second} lies in the frame of {flags.first} by {found.photos} photos that both have: turned by "
        f"{turn:.1f} degrees, scaled by {scale:.4g}; the median photo is off by {found.degrees:.2f} degrees and "
        f"{found.shift:.2%} of the cameras' radius"
    )
    for run, kept in zip(runs, merged.kept, strict=True):
        print(f"{run.path}: {kept:,} of {len(run.gaussians):,} splats stay")
    save_splats(flags.out, merged.gaussians, antialiased=runs[0].settings.antialiased, units=units_of(flags.first))
    compare(runs[0], merged.gaussians)
    compare(runs[1], found.place_back(merged.gaussians))
    print(f"{flags.out}: {len(merged.gaussians):,} splats, {flags.out.stat().st_size:,} bytes")
    return 0


def compare(run: FinishedRun, gaussians: Gaussians) -> None:
    """Print the PSNR of a run's held-out views, or else of its input views, by itself and merged."""
    from dataclasses import replace

    from gsopt.data.refined_poses import with_refined_poses
    from gsopt.data.scene import load_scene
    from gsopt.results.clean import input_psnr

    scene = with_refined_poses(load_scene(run.config.data), run.path)
    kind, views = ("held-out", scene.test) if scene.test else ("input", scene.train)
    views = views[:: -(-len(views) // MEASURED_VIEWS)]
    degree = replace(run.settings, sh_degree=gaussians.sh_degree)
    before, after = input_psnr(run, run.gaussians, views), input_psnr(replace(run, settings=degree), gaussians, views)
    print(f"{kind} views of {run.path}: {before:.2f} dB alone, {after:.2f} merged ({after - before:+.2f})")
