"""`gsopt finetune --library`: makes a shape library of a folder of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from gsopt.cli.console import report


@dataclass(frozen=True)
class Flags:
    """Make a library of shapes from meshes of your own domain; use it with gsopt train --prior library:FILE.

    Each mesh becomes 48³ voxels in coarse colors. Words come from the names of folders and files, from NAME.txt beside
    a mesh, from ShapeNet's taxonomy.json, or from a library.json (docs/howto/library.md). Broken meshes are skipped.
    """

    meshes: Annotated[Positional[Path], arg(metavar="MESHES")]
    """Folder of .obj, .glb, .gltf, .ply, .stl or .off files, ShapeNet's too, or a list of them as .json."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
    """The library, one file."""
    workers: int = 1
    """Processes that read meshes. The file does not depend on it."""


def main(argv: Sequence[str]) -> int:
    """Make the library, print what became of the meshes and return 0."""
    flags = tyro.cli(Flags, prog="gsopt finetune --library", args=list(argv))

    from gsopt.shape_library.meshes.build import build_library

    built = build_library(flags.meshes, flags.out, flags.workers, report)
    print(f"{built.entries:,} shapes, {built.skipped:,} meshes skipped, {built.bytes / 1e6:.1f} MB")
    print(f"{flags.out}: use it with gsopt train DATA --prior library:{flags.out} --prompt WORDS")
    return 0
