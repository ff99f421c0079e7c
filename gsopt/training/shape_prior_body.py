"""The body of one to three photos from a shape prior: opened, sampled and recorded before the first step."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsopt.config.guidance import GuidanceConfig, shape_prior_of
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic
from gsopt.geometry.surrounding import surrounding_cameras
from gsopt.init.guessed_views import COUNT, drawn_voxels
from gsopt.init.thumbnails import Thumbnail, small_photos
from gsopt.raster.backend import Backend
from gsopt.results.video import save_stills
from gsopt.shape_prior.completion import PriorBody, prior_body
from gsopt.shape_prior.diffusion import STEPS
from gsopt.shape_prior.folder import read_prior
from gsopt.shape_prior.vocabulary import known_words
from gsopt.training.few_photos import MAX_FEW_PHOTOS
from gsopt.training.library_body import expert_texts
from gsopt.training.plan import guesses
from gsopt.training.run_directory import RunDirectory

FOLDER = "shape_prior"
SHOWN_EVERY = 4
"""One in so many of the surrounding cameras draws the body for the report."""


def require_shape_prior(config: GuidanceConfig) -> None:
    """Raises InputError for a shape prior that cannot be read: before any work."""
    if (named := shape_prior_of(config.prior)) is not None:
        read_prior(Path(named))


def with_shape_prior_body(config: TrainConfig, scene: Scene, backend: Backend, directory: RunDirectory) -> Scene:
    """The scene with the body and the colors that `--prior shape:DIR` finds for its photos; else as it is."""
    named = shape_prior_of(config.guidance.prior)
    if named is None:
        return scene
    views = len(scene.train)
    if views > MAX_FEW_PHOTOS or not scene.has_alpha or scene.mirrored or not guesses(config, views):
        directory.warn(unused(scene))
        return scene
    began = time.process_time()
    prior = read_prior(Path(named))
    texts = expert_texts(config.guidance)
    known, unknown = known_words(texts, prior.vocabulary)
    record: dict[str, Any] = {"prior": Path(named).name, "digest": prior.digest, "steps": STEPS, "seed": config.seed}
    record |= {"texts": texts[:8], "words": known[:40], "unknown_words": unknown[:40], "photos": views}
    _require_the_same(directory, record)
    prior.network.to(backend.device)
    photos = small_photos(scene.train, views)
    body = prior_body(photos, scene.extent, prior, known, config.seed)
    if body is None:
        directory.warn(
            "The shape prior saw no body in the silhouettes: it is not used. Check the masks, or train it longer."
        )
        return scene
    seconds = time.process_time() - began
    if directory.recorded(FOLDER) is None:
        directory.record(**{FOLDER: {**record, "cpu_seconds": round(seconds, 3)}})
    directory.emit(FOLDER, message=sentence(Path(named).name, known))
    _show(body, photos, record, backend, directory.path / FOLDER)
    return replace(scene, body=body.grid, body_colors=body.colors)


def unused(scene: Scene) -> str:
    """Says why a run cannot use a shape prior, and what to do."""
    if scene.mirrored:
        return "The shape prior is not used: the silhouettes are those of a symmetric thing (--sparse.symmetry off)."
    views = f"{len(scene.train)} input view{'s' * (len(scene.train) != 1)} with{'' if scene.has_alpha else 'out'} masks"
    return (
        f"A shape prior completes an object that one to {MAX_FEW_PHOTOS} photos with alpha or masks show, unless "
        f"--sparse.inflate is off or poses are refined; got {views}: it is not used."
    )


def sentence(name: str, known: list[str]) -> str:
    """The origin of the unseen sides, for people."""
    words = f"told {', '.join(known[:6])}" if known else "told no word that it knows"
    return f"the unseen sides are a guess of {name} ({words})"


def _require_the_same(directory: RunDirectory, record: dict[str, Any]) -> None:
    recorded = directory.recorded(FOLDER)
    if recorded is not None and recorded.get("digest") != record["digest"]:
        raise InputError(
            f"The run began with another shape prior ({recorded.get('digest')}), got {record['digest']}. Restore its "
            "folder, or begin a new run."
        )


def _show(body: PriorBody, photos: list[Thumbnail], record: dict[str, Any], backend: Backend, folder: Path) -> None:
    """Pictures of the body on white, and the record, for the report."""
    cameras = surrounding_cameras(photos[0].camera, body.grid.centers().mean(0), COUNT)
    cameras = cameras[slice(SHOWN_EVERY // 2, None, SHOWN_EVERY)]
    images = drawn_voxels(body.grid, photos, cameras, backend, body.colors).float() / 255
    white = images[..., :3] * images[..., 3:] + 1 - images[..., 3:]
    folder.mkdir(exist_ok=True)
    shown = ((f"side_{i:02d}", (image * 255).round().byte()) for i, image in enumerate(white))
    save_stills(folder, shown, overwrite=True)
    write_atomic(folder / "summary.json", to_json(record))
