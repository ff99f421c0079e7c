"""Splat files come in without holding Blender up: read in a thread, handed over bit by bit by the timer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy

from . import splat_object
from .core import run_follower, statistics
from .core.errors import GsoptError, InputError
from .core.ply import read_ply
from .core.splats import Splats
from .core.spz import read_spz

SLICE = 0.005
"""Seconds of the main thread after which a tick begins nothing more."""
Finish = Callable[[Any, Any, statistics.Summary], Iterator[None]]
"""Gets the scene, the mesh and what can be said about it; goes on with a later tick after every yield."""
SUMMARIES: dict[str, statistics.Summary] = {}
"""By name of the mesh; made anew when asked for."""


def splat_file(path: Path) -> Path:
    """The file to read: itself, or what a run directory has. InputError where there is none."""
    if not path.is_dir():
        return path
    found = run_follower.splats_of(path)
    if found is None:
        raise InputError(f"{path} holds no splats yet. Wait for the first preview, or choose another run.")
    return found


def read(path: Path, progress: Callable[[float], None] = lambda share: None) -> Splats:
    """The splats of a PLY or SPZ file."""
    reader = {".ply": read_ply, ".spz": read_spz}.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path.name} is neither .ply nor .spz. Convert it with `gsopt export`.")
    return reader(path, progress)


class Loading:
    """Files on their way into meshes of a scene, one after the other."""

    def __init__(self, paths: list[Path], most: int, finish: Finish) -> None:
        self.paths, self.most, self.finish = paths, most, finish
        self.path = paths[0]
        self.share = 0.0
        self.error = ""
        self._read: list[tuple[Path, list[splat_object.Part], statistics.Summary]] = []
        self._steps: Iterator[Any] | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        try:
            for path in self.paths:
                self.path = path
                splats = read(path, self._tell)
                splats = splats.at_most(self.most) if self.most else splats
                self._read.append((path, splat_object.parts_of(splats), statistics.summary(splats)))
        except GsoptError as error:
            self.error = str(error)
        except MemoryError:
            self.error = f"{self.path.name} does not fit into memory. Close other files, or show fewer splats."
        except Exception as error:
            self.error = f"{self.path.name} could not be read: {error!r:.200}. Please report it."

    def _tell(self, share: float) -> None:
        self.share = (len(self._read) + share) / len(self.paths)

    def advance(self, scene: Any) -> bool:
        """Hand over for at most a slice of time; whether all is done or has failed."""
        if self._thread.is_alive():
            return False
        if self.error:
            return True
        if self._steps is None:
            self._steps = self._hand_over(scene)
        until = time.perf_counter() + SLICE
        return not any(pause or time.perf_counter() > until for pause in self._steps)

    def _hand_over(self, scene: Any) -> Iterator[bool]:
        """The meshes bit by bit, then what is made of them; True where the rest is for another tick."""
        while self._read:
            self.path, parts, summary = self._read.pop(0)
            for mesh in splat_object.mesh_in_steps(bpy, self.path.stem, parts):
                yield False
                if mesh is not None:
                    SUMMARIES[mesh.name] = summary
                    for _ in self.finish(scene, mesh, summary):
                        yield True
