"""Stages of mapping: what mappers are asked for, which reconstruction comes first, what an adjustment may move."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_answers import CHAIN, graph
from test_bundle_adjustment import photographed
from test_mapping_rules import Reconstruction, shared

import gsopt.data.sfm.mapping as mapping
from gsopt.data.sfm.mapping import keep_coherent
from gsopt.data.sfm.settings import SfmConfig

pycolmap = pytest.importorskip("pycolmap")


def posed(*names: str) -> Any:
    """Photos with other poses each, without points."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=9, height=9, params=[9.0, 9.0, 4.5, 4.5], camera_id=1)
    )
    for number, name in enumerate(names, 1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, number / 10])), np.array([1.0, 2.0, number]))
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
    return made


def test_poses_are_matrices_in_the_natural_order_of_names() -> None:
    names, viewmats = mapping.poses(posed("10.png", "9.png"))
    assert names == ["9.png", "10.png"]
    for viewmat, number in zip(viewmats, (2, 1), strict=True):
        c, s = np.cos(number / 10), np.sin(number / 10)
        expected = [[c, -s, 0, 1], [s, c, 0, 2], [0, 0, 1, number], [0, 0, 0, 1]]
        np.testing.assert_allclose(viewmat, expected, atol=1e-12)


def test_of_equal_groups_that_with_the_first_photo_stays() -> None:
    model = Reconstruction([1, 2, 3, 4], [*shared(20, 2, 3), *shared(20, 1, 4)])
    keep_coherent(model)
    assert model.photos == {1, 4}


def test_of_mappers_that_place_as_many_photos_the_first_is_kept_and_three_are_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(mapping, "run_mapper", lambda *_: [Reconstruction([1, 2, 3], shared(20, 1, 2, 3))])
    monkeypatch.setattr(mapping, "adjusted", lambda project, model: model)
    monkeypatch.setattr(mapping, "_settled", lambda project, model: pytest.fail("only a global model is settled"))
    project: Any = SimpleNamespace(config=SfmConfig())
    found = mapping.find_poses(project, graph(CHAIN), lambda line: None)
    assert found is not None
    assert (found.mapper, len(found.names)) == ("incremental", 3)


@pytest.mark.parametrize("mapper", ["incremental", "global", "held-lens"])
def test_a_mapper_begins_from_the_seed_in_a_folder_of_its_own_and_the_largest_coherent_model_comes_first(
    mapper: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of equally large ones that with the first name."""
    seeds: list[int] = []

    def run(project: Any, target: Path, *_: Any) -> list[Reconstruction]:
        assert target == tmp_path / mapper
        assert target.is_dir()
        assert seeds == [5]
        loose = Reconstruction([1, 2, 3, 4, 5], shared(20, 1, 2))
        models = [Reconstruction(rows, shared(20, *rows)) for rows in ([4, 5, 6], [3, 7, 8], [2, 3, 4, 5])]
        return [loose, *models]

    for name in ("_incremental", "_global", "_held"):
        monkeypatch.setattr(mapping, name, run)
    colmap = SimpleNamespace(set_random_seed=seeds.append)
    project: Any = SimpleNamespace(pycolmap=colmap, config=SfmConfig(seed=5), database=tmp_path / "a.db")
    placed = mapping.run_mapper(project, mapper, graph(CHAIN))
    assert [model.photos for model in placed] == [{2, 3, 4, 5}, {3, 7, 8}, {4, 5, 6}]


@pytest.mark.parametrize(("photos", "off", "moved"), [(40, 0.01, True), (39, 0.01, False), (40, 0.04, False)])
def test_principal_points_move_with_twenty_photos_a_camera_where_all_stay_near_the_middle(
    photos: int, off: float, moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solved(project: object, model: object, *, center: bool = False) -> Any:
        xs = (50.0, 50 + 100 * off * center)
        cameras = [SimpleNamespace(principal_point_x=x, principal_point_y=25.0, width=100, height=50) for x in xs]
        return SimpleNamespace(cameras=dict(enumerate(cameras)), center=center)

    monkeypatch.setattr(mapping, "bundle_adjusted", solved)
    model: Any = SimpleNamespace(num_reg_images=lambda: photos, cameras={1: None, 2: None})
    assert mapping.adjusted(None, model).center == moved  # type: ignore[arg-type]


def adjustment(made: Any, monkeypatch: pytest.MonkeyPatch, focal: float | None = None, **free: bool) -> tuple[Any, Any]:
    """What the solver is asked for."""
    asked: list[Any] = []

    class Solver:
        def __init__(self, options: Any, config: Any, *_: Any) -> None:
            asked.extend([options, config])

        def solve(self) -> None: ...

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", Solver)
    project: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig(focal=focal, max_size=500))
    mapping.bundle_adjusted(project, made, **free)
    return asked[0], asked[1]


@pytest.mark.parametrize(
    ("free", "focal", "poses", "length", "lens", "center"),
    [
        ({}, None, True, True, True, False),
        ({}, 900.0, True, False, True, False),
        ({"lens": False}, None, True, True, False, False),
        ({"center": True}, None, True, True, True, True),
        ({"poses": False}, None, False, False, True, False),
        ({"poses": False, "lens": False}, 900.0, False, False, False, False),
    ],
)
def test_an_adjustment_moves_poses_and_the_lens_unless_told_otherwise(
    free: dict[str, bool],
    focal: float | None,
    poses: bool,
    length: bool,
    lens: bool,
    center: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All photos take part, on one thread, and two cameras fix the gauge where poses may move."""
    options, everything = adjustment(photographed(0.0, 0.0), monkeypatch, focal, **free)
    assert (options.refine_rig_from_world, options.refine_focal_length) == (poses, length)
    assert (options.refine_extra_params, options.refine_principal_point) == (lens, center)
    assert options.ceres.solver_options.num_threads == 1
    assert sorted(everything.images) == [1, 2, 3, 4, 5]
    gauge = pycolmap.BundleAdjustmentGauge
    assert everything.fixed_gauge == (gauge.TWO_CAMS_FROM_WORLD if poses else gauge.UNSPECIFIED)


def test_the_scale_of_errors_follows_the_longest_side_of_all_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    made = posed("a.png")
    for number, (width, height) in enumerate([(600, 1500), (300, 200)], 2):
        params = [100.0, 100.0, width / 2, height / 2]
        made.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=number)
        )
    assert adjustment(made, monkeypatch)[0].ceres.loss_function_scale == pytest.approx(0.25 * 1500 / 500)


def test_after_an_adjustment_observations_miss_by_four_px_at_most_and_errors_are_those_of_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The copy alone changes; here nothing is moved, so that errors are the shifts."""
    made = photographed(0.0, 0.0)
    for row, shift in enumerate((3.9, 4.1)):
        made.image(3).points2D[row].xy = made.image(3).points2D[row].xy + np.array([shift, 0])

    class Solver:
        def __init__(self, *_: Any) -> None: ...

        def solve(self) -> None: ...

    monkeypatch.setattr(pycolmap, "create_default_bundle_adjuster", Solver)
    project: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig())
    kept = mapping.bundle_adjusted(project, made)
    assert [kept.point3D(number).track.length() for number in (1, 2, 3)] == [5, 4, 5]
    assert [kept.point3D(number).error for number in (1, 2)] == pytest.approx([3.9 / 5, 0], abs=1e-6)
    assert [made.point3D(number).track.length() for number in (1, 2)] == [5, 5]


@pytest.mark.parametrize("start", ["", "start"])
def test_incremental_mapping_makes_several_models_unless_it_grows_one(start: str, tmp_path: Path) -> None:
    def incremental(*where: Path, options: Any, input_path: str) -> dict[int, str]:
        assert where == (tmp_path / "a.db", tmp_path, tmp_path / "target")
        assert (options.multiple_models, input_path) == (not start, start)
        return {1: "second", 0: "first"}

    colmap = SimpleNamespace(IncrementalPipelineOptions=SimpleNamespace, incremental_mapping=incremental)
    project: Any = SimpleNamespace(pycolmap=colmap, config=SfmConfig(), database=tmp_path / "a.db", photos=tmp_path)
    assert mapping._incremental(project, tmp_path / "target", start) == ["first", "second"]


@pytest.mark.parametrize("focal", [None, 900.0])
def test_global_mapping_calibrates_a_copy_of_the_database_unless_the_focal_length_is_given(
    focal: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    target, database = tmp_path / "global", tmp_path / "a.db"
    target.mkdir()
    database.write_text("matches")

    def calibrate(path: Path, options: Any) -> None:
        assert options.random_seed == 5
        path.write_text(path.read_text() + ", calibrated")
        steps.append("calibrated")

    def run(path: Path, photos: Path, folder: Path, options: Any) -> dict[int, str]:
        assert path.read_text() == ("matches, calibrated" if focal is None else "matches")
        assert (photos, folder) == (tmp_path, target)
        assert (options.num_threads, options.random_seed, options.min_model_size) == (1, 5, 3)
        assert options.mapper.bundle_adjustment.refine_focal_length == (focal is None)
        return {1: "second", 0: "first"}

    monkeypatch.setattr(mapping, "_calibrate_by_seed", lambda project, *_: steps.append(project.database.parent.name))
    colmap = SimpleNamespace(
        ViewGraphCalibrationOptions=pycolmap.ViewGraphCalibrationOptions,
        GlobalPipelineOptions=pycolmap.GlobalPipelineOptions,
        calibrate_view_graph=calibrate,
        global_mapping=run,
    )
    project: Any = mapping.ColmapProject(colmap, database, tmp_path, SfmConfig(focal=focal, seed=5))  # type: ignore[arg-type]
    assert mapping._global(project, target, graph(CHAIN)) == ["first", "second"]
    assert steps == (["global", "calibrated"] if focal is None else [])
    assert database.read_text() == "matches"


@pytest.mark.parametrize("focal", [None, 900.0])
def test_a_global_model_is_adjusted_and_triangulated_twice(
    focal: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def triangulate(
        model: str, database: Path, photos: Path, folder: Path, *, options: Any, refine_intrinsics: bool
    ) -> str:
        assert folder.is_dir()
        assert list(folder.iterdir()) == []
        (folder / "points").touch()
        assert refine_intrinsics == (focal is None)
        return f"{model}, triangulated"

    monkeypatch.setattr(mapping, "adjusted", lambda project, model: f"{model}, adjusted")
    colmap = SimpleNamespace(IncrementalPipelineOptions=SimpleNamespace, triangulate_points=triangulate)
    project: Any = SimpleNamespace(
        pycolmap=colmap, config=SfmConfig(focal=focal), database=tmp_path / "a.db", photos=tmp_path
    )
    assert mapping._settled(project, "model") == "model" + ", adjusted, triangulated" * 2
