"""`gsopt mesh`: turn the splats of a run into a closed mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gsopt import check


@dataclass(frozen=True)
class Flags:
    """Turn the splats of a finished run into a closed mesh with colors: an object's, or the shell of a scene."""

    run: tyro.conf.Positional[Path]
    """The run directory that `gsopt train` wrote."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write: .glb, .ply or .obj."""
    faces: int = 20_000
    """Triangles after decimation."""
    voxels: int = 128
    """Resolution along the longest side, before decimation."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Mesh only this box: x y z X Y Z, scene units. The object, or what the cameras look at, when not given."""
    force: bool = False
    """Replace OUT if it exists."""
    threads: int | None = None
    """Draw with this many threads instead of the run's; 0 = one per core."""


def main(argv: Sequence[str]) -> int:
    """Extract, write, print the size and return 0."""
    flags = tyro.cli(Flags, prog="gsopt mesh", args=list(argv))

    from gsopt.formats import suffix_of
    from gsopt.formats.mesh_files import SUFFIXES, save_mesh
    from gsopt.results.finished_run import open_run
    from gsopt.results.measure import units_of
    from gsopt.results.mesh.extract import extract_mesh

    suffix_of(flags.out, SUFFIXES)
    check.writable(flags.out, flags.force)
    run = open_run(flags.run, threads=flags.threads)
    mesh = extract_mesh(run, faces=flags.faces, voxels=flags.voxels, box=flags.box)
    save_mesh(flags.out, mesh, units_of(flags.run))
    size = flags.out.stat().st_size
    print(f"{flags.out}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces, {size:,} bytes")
    return 0
