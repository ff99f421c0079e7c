"""Before the first step: the symmetries of the object, found once, then kept with the run."""

from __future__ import annotations

from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.errors import InputError
from gsopt.symmetry.find import find_symmetries, with_mirror_images
from gsopt.symmetry.symmetry import Symmetry
from gsopt.training.open_settings import is_sparse
from gsopt.training.run_directory import RunDirectory


def symmetries(config: TrainConfig, scene: Scene) -> list[Symmetry]:
    """The symmetries this run uses: none unless the photos are few and all have alpha. Not while poses are corrected:
    their errors would go into them."""
    few = is_sparse(config.sparse, len(scene.train))
    wanted = few and config.sparse.symmetry == "auto" and not config.poses.refine
    return find_symmetries(scene) if wanted else []


def with_mirrors(config: TrainConfig, scene: Scene) -> Scene:
    """The scene with the mirror images of its photos, where they are few and the object is symmetric."""
    return with_mirror_images(scene, symmetries(config, scene))


def with_recorded_mirrors(config: TrainConfig, scene: Scene, directory: RunDirectory) -> Scene:
    """The same; a resumed run keeps the mirrors it began with. InputError for a garbled record."""
    recorded = directory.recorded("symmetry")
    if recorded is None:
        recorded = [symmetry.to_dict() for symmetry in symmetries(config, scene)]
        directory.record(symmetry=recorded)
    try:
        return with_mirror_images(scene, [Symmetry.from_dict(values) for values in recorded])
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError(
            f"`symmetry` in {directory.path / 'config.json'} lacks or garbles {error}. Start in another folder."
        ) from error
