"""`gsopt export`: write splats in another format."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gsopt import check
from gsopt.errors import InputError, UsageError
from gsopt.formats import READABLE, SUFFIXES, is_antialiased, load_splats, save_splats, suffix_of

if TYPE_CHECKING:
    from gsopt.gaussians import Gaussians

SPLATS_OF_RUN = "splat.ply"
RECORDS_ANTIALIASED = (".ply", ".spz", ".sog")
"""Formats that record that splats need the 2D filter of Mip-Splatting."""


PAGE = ".html"
MEASURED_VIEWS = 24
"""Most views of each kind that --decimate is measured on."""


@dataclass(frozen=True)
class Flags:
    """Write splats in another format, or as a page that shows them in any browser; nothing is left half-written."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")]
    """A splat file or a run directory (its splat.ply)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write; its ending chooses the format: .ply, .compressed.ply, .splat, .spz, .sog, .glb, .usda, .usdc,
    or .html: one page with viewer, input cameras and camera path, which needs no network."""
    force: bool = False
    """Replace OUT if it exists."""
    decimate: str = "100%"
    """Keep this share of the splats, as 25%: neighbors are merged, those that a run's input views hardly see left out.
    A run prints what that costs its views."""
    strict: bool = False
    """Refuse a file with a splat that cannot be drawn (NaN, no rotation) instead of leaving that splat out."""


def main(argv: Sequence[str]) -> int:
    """Convert, print the size of the file and return 0."""
    flags = tyro.cli(Flags, prog="gsopt export", args=list(argv))
    out = flags.out
    suffix, share = suffix_of(out, (*SUFFIXES, PAGE)), share_of(flags.decimate)
    if suffix == PAGE and share < 1:
        raise UsageError("`--decimate` is for splat files. Export one, then make the page of that file.")
    check.writable(out, flags.force)
    from gsopt.results.measure import units_of

    source = splats_in(flags.source)
    antialiased = is_antialiased(source)
    gaussians = load_splats(source, strict=flags.strict)
    if share < 1:
        gaussians = fewer(flags.source, gaussians, share)
    if suffix == PAGE:
        write_page(flags.source, gaussians, out, antialiased)
    else:
        save_splats(out, gaussians, antialiased=antialiased, units=units_of(flags.source))
        note_losses(suffix, gaussians.sh_degree, antialiased)
    print(f"{out}: {len(gaussians):,} splats, {out.stat().st_size:,} bytes")
    return 0


def share_of(text: str) -> float:
    """`25%` as 0.25; UsageError for anything else."""
    try:
        share = float(text.removesuffix("%")) / 100 if text.endswith("%") else 0.0
    except ValueError:
        share = 0.0
    if not 0 < share <= 1:
        raise UsageError(f"`--decimate` must be more than 0% and at most 100%, got {text}. Give a share as 25%.")
    return share


def fewer(source: Path, gaussians: Gaussians, share: float) -> Gaussians:
    """A share of the splats; prints the PSNR of a run's views before and after."""
    from gsopt.data.refined_poses import with_refined_poses
    from gsopt.data.scene import load_scene
    from gsopt.results.clean import input_psnr, observe
    from gsopt.results.decimate import decimated
    from gsopt.results.finished_run import open_run

    if not (source / "config.json").is_file():
        return decimated(gaussians, share)
    run = open_run(source)
    scene = with_refined_poses(load_scene(run.config.data), run.path)
    left = decimated(gaussians, share, observe(gaussians, scene.train, run.backend).weight)
    for name, views in (("input", scene.train), ("held-out", scene.test)):
        if views:
            before, after = (input_psnr(run, splats, views[:MEASURED_VIEWS]) for splats in (gaussians, left))
            print(f"{name} views: {before:.2f} dB, with {share:.0%} of the splats {after:.2f} ({after - before:+.2f})")
    return left


def write_page(source: Path, gaussians: Gaussians, out: Path, antialiased: bool) -> None:
    """The page of a run, with its cameras, or of a file."""
    from gsopt.results import web
    from gsopt.results.measure import units_of

    if (source / "config.json").is_file():
        web.save_run_page(out, source)
    else:
        units = units_of(source)
        web.save_page(out, gaussians, web.scene_of_splats(gaussians, source.name, antialiased=antialiased, units=units))


def note_losses(suffix: str, sh_degree: int, antialiased: bool) -> None:
    """Print on stderr what the format cannot hold."""
    if suffix == ".splat" and sh_degree > 0:
        print("gsopt: note: .splat has no view-dependent color; bands 1 and up were dropped", file=sys.stderr)
    if antialiased and suffix not in RECORDS_ANTIALIASED:
        print(f"gsopt: note: {suffix} cannot record that these splats need antialiased rendering", file=sys.stderr)


def splats_in(source: Path) -> Path:
    """The splat file that `source` is, or that lies in the run directory it names."""
    if not source.is_dir():
        return source
    splats = source / SPLATS_OF_RUN
    if not splats.is_file():
        raise InputError(
            f"{source} must be a finished run or a file ({', '.join(READABLE)}), got a folder without {SPLATS_OF_RUN}. "
            "Wait until the run is done, or name one of its previews."
        )
    return splats
