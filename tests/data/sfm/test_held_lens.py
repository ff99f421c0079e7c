"""A lens is held while photos are placed: which focal lengths are tried, and which reconstruction is kept."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsopt.data.sfm import mapping
from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.settings import SfmConfig

pycolmap = pytest.importorskip("pycolmap")


def database_of_lenses(folder: Path) -> Path:
    """A database with a camera whose focal length is known and one whose is guessed."""
    database = folder / "photos.db"
    with pycolmap.Database.open(database) as db:
        for focal, known in ((123.0, True), (50.0, False)):
            camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", focal, 100, 80)
            camera.has_prior_focal_length = known
            db.write_camera(camera)
    return database


def held_models(
    tmp_path: Path, placed: dict[float, list[int]], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[Any], list[float]]:
    """The models of the held lens, and the focal lengths that were tried; `placed` has photos per model by focal."""
    tried: list[float] = []

    def incremental(database: Path, photos: Path, target: Path, *, options: Any) -> dict[int, Any]:
        assert not options.ba_refine_focal_length
        assert not options.ba_refine_extra_params
        assert not options.mapper.abs_pose_refine_focal_length
        with pycolmap.Database.open(database) as db:
            lenses = {camera.camera_id: camera.params[0] for camera in db.read_all_cameras()}
        assert lenses.pop(1) == 123.0
        tried.append(lenses[2] / 100)
        return {
            row: SimpleNamespace(name=f"{tried[-1]}", num_reg_images=lambda n=n: n, num_images=lambda: 10, row=row)
            for row, n in enumerate(placed[tried[-1]])
        }

    database = database_of_lenses(tmp_path)
    colmap: Any = SimpleNamespace(
        Database=pycolmap.Database,
        Camera=pycolmap.Camera,
        IncrementalPipelineOptions=pycolmap.IncrementalPipelineOptions,
        incremental_mapping=incremental,
    )
    monkeypatch.setattr(mapping, "registered", lambda model: {str(model.row)})
    monkeypatch.setattr(mapping, "bundle_adjusted", lambda project, model: model)
    monkeypatch.setattr(mapping, "support", lambda model: float(model.name))
    project = ColmapProject(colmap, database, tmp_path, SfmConfig())
    models = mapping._held(project, tmp_path)
    with pycolmap.Database.open(database) as db:
        assert [camera.params[0] for camera in db.read_all_cameras()] == [123.0, 50.0]
    return models, tried


@pytest.mark.parametrize(
    ("placed", "tried", "best"),
    [
        ({1.2: [4, 9]}, [1.2], [("1.2", 9), ("1.2", 4)]),
        ({1.2: [8], 1.9: [3, 10]}, [1.2, 1.9], [("1.9", 10), ("1.9", 3)]),
        ({1.2: [8], 1.9: [8], 0.75: [7]}, [1.2, 1.9, 0.75], [("1.9", 8)]),
        ({1.2: [], 1.9: [3], 0.75: []}, [1.2, 1.9, 0.75], [("1.9", 3)]),
        ({1.2: [], 1.9: [], 0.75: []}, [1.2, 1.9, 0.75], []),
    ],
)
def test_focal_lengths_are_held_until_one_places_enough_photos(
    placed: dict[float, list[int]],
    tried: list[float],
    best: list[tuple[str, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    models, asked = held_models(tmp_path, placed, monkeypatch)
    assert asked == tried
    assert [(model.name, model.num_reg_images()) for model in models] == best


def test_one_small_reconstruction_of_the_best_connected_photos_calibrates_a_lens_without_exif(tmp_path: Path) -> None:
    """The largest one that is found; a lens from EXIF stays, and where all are known nothing is reconstructed."""
    asked: list[Any] = []

    def incremental(database: Path, photos: Path, target: Path, *, options: Any) -> dict[int, Any]:
        asked.append(options)
        found = {}
        for number, focal in enumerate((90.0, 77.0)):
            model = pycolmap.Reconstruction()
            for camera_id, length in ((1, 200.0), (2, focal)):
                lens = pycolmap.Camera(
                    model="SIMPLE_RADIAL", width=100, height=80, params=[length, 50, 40, 0], camera_id=camera_id
                )
                model.add_camera_with_trivial_rig(lens)
            for image_id in range(1, 3 + 2 * number):
                image = pycolmap.Image(name=f"{image_id}.png", camera_id=1 + image_id % 2, image_id=image_id)
                model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
            found[number] = model
        return found

    database = database_of_lenses(tmp_path)
    colmap: Any = SimpleNamespace(
        Database=pycolmap.Database,
        IncrementalPipelineOptions=pycolmap.IncrementalPipelineOptions,
        incremental_mapping=incremental,
    )
    project = ColmapProject(colmap, database, tmp_path, SfmConfig())
    names = [f"{number:02d}.png" for number in range(20)]
    chain = {(a, b): 99 - row for row, (a, b) in enumerate(itertools.pairwise(names))}
    graph = ViewGraph(dict.fromkeys(names, 900), chain, frozenset())
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        mapping._calibrate_by_seed(project, tmp_path / folder, graph)
    (options,) = asked
    assert not options.multiple_models
    assert sorted(options.image_names) == names[:16]
    with pycolmap.Database.open(database) as db:
        assert [(camera.params[0], camera.has_prior_focal_length) for camera in db.read_all_cameras()] == [
            (123.0, True),
            (77.0, True),
        ]
