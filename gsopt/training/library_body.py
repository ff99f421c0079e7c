"""The body of one photo from a shape library: opened, searched and recorded before the first step."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from gsopt.config.guidance import GuidanceConfig, chooses_itself, library_of
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.events import to_json, write_atomic
from gsopt.init.thumbnails import small_photos
from gsopt.raster.backend import Backend
from gsopt.results.video import save_stills
from gsopt.sds.prompts import read_set
from gsopt.shape_library.completion import Completion, completion
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary
from gsopt.shape_library.pictures import picture
from gsopt.training.plan import guesses
from gsopt.training.run_directory import RunDirectory

FOLDER = "library"
SHOWN = 6
"""Shapes that the report shows."""
LEAST_SHARE = 0.01


def require_library(config: GuidanceConfig) -> None:
    """Raises InputError for a shape library that cannot be read: before any work."""
    named = library_of(config.prior)
    if named is not None and not (named and Path(named).is_dir()):
        ShapeLibrary(Path(named) if named else BUNDLED)


def with_library_body(config: TrainConfig, scene: Scene, backend: Backend, directory: RunDirectory) -> Scene:
    """The scene with the body that a library finds for its only photo, the bundled one where no prior or weight is
    given (docs/decisions/0021-library-by-default.md); else as it is."""
    asked = library_of(config.guidance.prior)
    if asked is None and not chooses_itself(config.guidance):
        return scene
    if len(scene.train) != 1 or not scene.has_alpha or scene.mirrored or not guesses(config, 1):
        if asked is not None:
            directory.warn(unused(scene))
        return scene
    began = time.process_time()
    library = _opened(asked or "", directory)
    texts = expert_texts(config.guidance)
    found = completion(small_photos(scene.train, 1)[0], scene.extent, library, texts)
    if found is None:
        return scene
    _record(found, library, texts, time.process_time() - began, backend, directory)
    return replace(scene, body=found.body)


def unused(scene: Scene) -> str:
    """Says why a run cannot use a library, and what to do."""
    if scene.mirrored:
        return "The shape library is not used: the silhouette is that of a symmetric thing (--sparse.symmetry off)."
    views = f"{len(scene.train)} input view{'s' * (len(scene.train) != 1)} with{'' if scene.has_alpha else 'out'} masks"
    return (
        "A shape library completes an object that one photo with alpha or a mask shows, unless --sparse.inflate is off "
        f"or poses are refined; got {views}: it is not used."
    )


def expert_texts(config: GuidanceConfig) -> list[str]:
    """The texts in which the expert, the template or the language model says what the object is."""
    texts = list(config.prompt)
    if config.prompts:
        prompts = read_set(Path(config.prompts))
        texts += [prompts.object, prompts.notes]
        texts += [one.text for one in prompts.prompts if one.polarity == "positive" and one.weight > 0]
    return [text for text in texts if text.strip()]


def _opened(named: str, directory: RunDirectory) -> ShapeLibrary:
    """The bundled library, a file, or a folder of meshes, which becomes a file in the run's folder first."""
    if not named:
        return ShapeLibrary(BUNDLED)
    path = Path(named)
    if not path.is_dir():
        return ShapeLibrary(path)
    from gsopt.shape_library.meshes.build import build_library

    folder = directory.path / FOLDER
    folder.mkdir(exist_ok=True)
    made = folder / "library.safetensors"
    if not made.exists():
        built = build_library(path, made, 1, lambda line: directory.emit("library", message=line))
        directory.emit("library", message=f"{built.entries:,} shapes of {path}, {built.skipped:,} skipped")
    return ShapeLibrary(made)


def _record(
    found: Completion,
    library: ShapeLibrary,
    texts: list[str],
    seconds: float,
    backend: Backend,
    directory: RunDirectory,
) -> None:
    """The shapes found: in config.json, as an event, and with pictures for the report."""
    shown = [one for one in found.hypotheses if one.share >= LEAST_SHARE][:SHOWN]
    shapes = [
        {**asdict(one.entry), "share": one.share, "agreement": one.agreement, "words": one.words} for one in shown
    ]
    path = "bundled" if library.path == BUNDLED else str(library.path)
    record: dict[str, Any] = {"library": path, "entries": len(library), "texts": texts[:8], "shapes": shapes}
    if directory.recorded(FOLDER) is None:
        directory.record(**{FOLDER: {**record, "cpu_seconds": round(seconds, 3)}})
    directory.emit("library", message=sentence(found), shapes=[one.entry.id for one in shown])
    folder = directory.path / FOLDER
    folder.mkdir(exist_ok=True)
    index = {entry.id: row for row, entry in enumerate(library.entries)}
    pictures = [(f"shape_{i:02d}", picture(library.shape(index[one.entry.id]), backend)) for i, one in enumerate(shown)]
    save_stills(folder, pictures, overwrite=True)
    write_atomic(folder / "summary.json", to_json(record))


def sentence(found: Completion) -> str:
    """The shapes with the largest shares, for people."""
    best = found.hypotheses[:3]
    listed = ", ".join(f"{one.entry.title} {one.share:.0%}" for one in best if one.share >= LEAST_SHARE)
    words = "chosen by the photo and by words" if any(one.words for one in best) else "chosen by the photo"
    return f"the unseen sides follow {listed} ({words})"
