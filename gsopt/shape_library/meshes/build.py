"""Makes a shape library of a folder of meshes. Broken meshes are skipped, named and counted."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from gsopt._optional import require
from gsopt.errors import GsoptError, InputError
from gsopt.events import Report
from gsopt.shape_library.entry import Entry
from gsopt.shape_library.library_file import packed, write_library
from gsopt.shape_library.meshes.mesh_list import Source, find_meshes
from gsopt.shape_library.meshes.mesh_points import read_points
from gsopt.shape_library.meshes.voxelize import FINE_SIDE, voxelized

REPORT_SECONDS = 10.0
MAX_NAMED = 20
"""Broken meshes that are named; the others are counted."""


@dataclass(frozen=True)
class Built:
    """The outcome of making a library."""

    entries: int
    skipped: int
    bytes: int


@dataclass(frozen=True)
class _Row:
    """One mesh, read; or the reason why not."""

    entry: Entry
    stream: bytes = b""
    sizes: tuple[float, ...] = ()
    problem: str = ""


def build_library(meshes: Path, out: Path, workers: int, report: Report) -> Built:
    """Writes the library `out`. Raises InputError for an `out` that exists, and when no mesh can be read."""
    if out.exists():
        raise InputError(f"{out} exists already. Give another -o, or remove it.")
    if not out.absolute().parent.is_dir():
        raise InputError(f"There is no folder {out.absolute().parent} to write the library to. Make it first.")
    require("trimesh", "library", "Reading meshes")
    sources = find_meshes(meshes)
    report(f"{len(sources):,} meshes")
    made, skipped, told = [], 0, time.monotonic()
    for done, row in enumerate(_rows(sources, workers), 1):
        if row.problem:
            skipped += 1
            if skipped <= MAX_NAMED:
                report(f"skipped {row.entry.id}: {row.problem}")
        else:
            made.append(row)
        if time.monotonic() - told > REPORT_SECONDS:
            report(f"{done:,} of {len(sources):,} meshes, {skipped:,} skipped")
            told = time.monotonic()
    if not made:
        raise InputError(f"None of the {len(sources):,} meshes of {meshes} can be read; the reasons stand above.")
    sizes = [np.array(row.sizes, np.float32) for row in made]
    write_library(out, [row.entry for row in made], [row.stream for row in made], sizes)
    return Built(len(made), skipped, out.stat().st_size)


def _rows(sources: list[Source], workers: int) -> Iterator[_Row]:
    """In the order of the sources, whatever the number of workers."""
    if workers <= 1:
        yield from map(_row, sources)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(_row, sources, chunksize=4)


def _row(source: Source) -> _Row:
    """Reads and fills one mesh; whatever it is, the others go on."""
    try:
        shape = voxelized(read_points(source.mesh, FINE_SIDE, source.up))
    except (GsoptError, MemoryError) as error:
        return _Row(source.entry, problem=str(error) or type(error).__name__)
    return _Row(source.entry, packed(shape), tuple(map(float, shape.sizes)))
