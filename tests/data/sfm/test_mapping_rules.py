"""Rules by which photos and reconstructions are kept, met exactly, on reconstructions made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from test_answers import CHAIN, NAMES, graph

from gsopt.data.sfm import few_photos, mapping
from gsopt.data.sfm.few_photos import Attempt, observations
from gsopt.data.sfm.held_lens import focals_to_try
from gsopt.data.sfm.mapping import covisible_groups, keep_coherent, mappers_to_try, off_center, seed_photos
from gsopt.data.sfm.settings import SfmConfig


class Reconstruction:
    """Photos by number, and points as (photos that see it, error)."""

    def __init__(self, photos: list[int], points: list[tuple[list[int], float]]) -> None:
        self.photos = set(photos)
        self.all_points = points

    @property
    def points3D(self) -> dict[int, Any]:
        shown = [([i for i in seen if i in self.photos], error) for seen, error in self.all_points]
        return {
            number: SimpleNamespace(
                error=error,
                track=SimpleNamespace(elements=[SimpleNamespace(image_id=i) for i in seen], length=[*seen].__len__),
            )
            for number, (seen, error) in enumerate(shown)
            if len(seen) > 1
        }

    @property
    def cameras(self) -> dict[int, Any]:
        return {1: lens(0.75)}

    def reg_image_ids(self) -> list[int]:
        return sorted(self.photos)

    def num_reg_images(self) -> int:
        return len(self.photos)

    def image(self, number: int) -> Any:
        seen = sum(number in photos for photos, _ in self.all_points)
        return SimpleNamespace(name=f"{number}.jpg", frame_id=100 + number, num_points3D=seen)

    def deregister_frame(self, frame: int) -> None:
        self.photos.remove(frame - 100)


def lens(sides: float, *, known: bool = False) -> Any:
    """A camera with a focal length of so many longer sides of its photos."""
    return SimpleNamespace(width=300, height=400, mean_focal_length=lambda: 400 * sides, has_prior_focal_length=known)


def shared(count: int, *photos: int, error: float = 0.5) -> list[tuple[list[int], float]]:
    return [(list(photos), error)] * count


@pytest.mark.parametrize(("count", "kept"), [(15, {1, 2, 3}), (14, {1, 2})])
def test_a_photo_hangs_on_by_fifteen_points_shared_with_another(count: int, kept: set[int]) -> None:
    model = Reconstruction([1, 2, 3], [*shared(40, 1, 2), *shared(count, 2, 3)])
    assert covisible_groups(model) == [kept]
    keep_coherent(model)
    assert model.photos == kept


def test_the_largest_group_stays_and_of_equal_ones_the_first() -> None:
    model = Reconstruction([1, 2, 3, 4, 5], [*shared(99, 1, 2), *shared(20, 3, 4), *shared(20, 4, 5)])
    keep_coherent(model)
    assert model.photos == {3, 4, 5}
    model = Reconstruction([1, 2, 3, 4], [*shared(20, 3, 4), *shared(20, 1, 2)])
    keep_coherent(model)
    assert model.photos == {1, 2}
    model = Reconstruction([1, 2], [])
    keep_coherent(model)
    assert model.photos == set()


def test_a_track_joins_every_photo_that_sees_it() -> None:
    assert covisible_groups(Reconstruction([1, 2, 3, 4], shared(15, 1, 2, 3, 4))) == [{1, 2, 3, 4}]


def test_the_median_photo_speaks_for_a_reconstruction() -> None:
    assert observations(Reconstruction([1, 2, 3], [*shared(10, 1, 2), *shared(5, 2, 3)])) == 10
    assert observations(Reconstruction([], [])) == 0


def test_support_falls_with_the_squared_error_and_ends_at_its_scale() -> None:
    def support(error: float) -> float:
        return Attempt(Reconstruction([1, 2, 3], shared(1, 1, 2, 3, error=error)), "").support  # type: ignore[arg-type]

    assert [support(error) for error in (0.0, 0.75, 1.5, 2.0)] == pytest.approx([3, 2.25, 0, 0])
    assert Attempt(Reconstruction([1, 2], []), "").photos == 2


def test_a_principal_point_is_off_by_the_larger_share() -> None:
    camera = SimpleNamespace(principal_point_x=52.0, principal_point_y=20.0, width=100, height=50)
    assert off_center(camera) == pytest.approx(0.1)
    assert off_center(SimpleNamespace(**{**vars(camera), "principal_point_y": 25.0})) == pytest.approx(0.02)


@pytest.mark.parametrize(("photos", "off", "moved"), [(20, 0.0299, True), (19, 0.0, False), (20, 0.0301, False)])
def test_the_principal_point_of_twenty_photos_may_move_a_little(
    photos: int, off: float, moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solved(project: object, model: object, *, center: bool = False, lens: bool = True) -> Any:
        x = 50 + 100 * off * center
        camera = SimpleNamespace(principal_point_x=x, principal_point_y=25.0, width=100, height=50)
        return SimpleNamespace(cameras={1: camera}, center=center)

    monkeypatch.setattr(mapping, "bundle_adjusted", solved)
    model: Any = SimpleNamespace(num_reg_images=lambda: photos, cameras={1: None})
    assert mapping.adjusted(None, model).center == moved  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "mappers"),
    [
        (16, ["incremental", "hybrid"]),
        (17, ["incremental", "held-lens", "hybrid"]),
        (300, ["incremental", "held-lens", "hybrid"]),
        (301, ["hybrid", "incremental", "held-lens"]),
    ],
)
def test_few_photos_are_mapped_one_by_one_first(count: int, mappers: list[str]) -> None:
    assert mappers_to_try(SfmConfig(), count) == mappers
    assert mappers_to_try(SfmConfig(mapper="global"), count) == ["global"]


def test_seed_photos_are_the_best_connected_ones() -> None:
    found = graph({(0, 1): 5, (1, 2): 9, (2, 3): 7, (3, 4): 8, (0, 4): 1, (4, 5): 100}, still=((4, 5),))
    assert seed_photos(found, 3) == ["1.jpg", "2.jpg", "3.jpg"]
    assert seed_photos(found, 99) == ["1.jpg", "2.jpg", "3.jpg", "4.jpg", "0.jpg"]
    assert seed_photos(graph({(4, 5): 100}, still=((4, 5),)), 2) == ["0.jpg", "1.jpg"]
    ties = graph({(0, 1): 5, (2, 3): 5, (1, 2): 1, (0, 3): 1})
    assert seed_photos(ties, 4) == ["2.jpg", "3.jpg", "1.jpg", "0.jpg"]


@pytest.mark.parametrize(("first", "tried"), [(18, ["incremental"]), (17, ["incremental", "held-lens", "hybrid"])])
def test_another_mapper_is_tried_where_less_than_nine_tenths_are_placed(
    first: int, tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[str] = []

    def run(project: object, mapper: str, graph: object) -> list[Reconstruction]:
        runs.append(mapper)
        count = first if mapper == "incremental" else first - 1
        chain = [point for i in range(1, count) for point in shared(20, i, i + 1)]
        return [Reconstruction(list(range(1, count + 1)), chain), Reconstruction([count, count + 1], [])]

    monkeypatch.setattr(mapping, "run_mapper", run)
    monkeypatch.setattr(mapping, "adjusted", lambda project, model: model)
    monkeypatch.setattr(mapping, "_settled", lambda project, model: model)
    project: Any = SimpleNamespace(config=SfmConfig())
    twenty = replace(graph({}), features={f"{i}.jpg": 900 for i in range(1, 21)})
    found = mapping.find_poses(project, twenty, lambda line: None)
    assert runs == tried
    assert found is not None
    assert (found.mapper, found.names) == ("incremental", {f"{i}.jpg" for i in range(1, first + 1)})
    assert found.others == [{f"{first + 1}.jpg"}]


@pytest.mark.parametrize(
    ("sides", "known", "focal", "real"),
    [
        (0.25, False, None, True),
        (0.24, False, None, False),
        (8.0, False, None, True),
        (8.1, False, None, False),
        (33.0, False, None, False),
        (33.0, True, None, True),
        (33.0, False, 13200.0, True),
    ],
)
def test_poses_that_need_a_lens_which_no_camera_has_are_given_up(
    sides: float, known: bool, focal: float | None, real: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that EXIF or the user names is believed."""
    monkeypatch.setattr(Reconstruction, "cameras", {1: lens(0.75), 2: lens(sides, known=known)})
    chain = [point for i in range(1, 6) for point in shared(20, i, i + 1)]
    monkeypatch.setattr(mapping, "run_mapper", lambda *_: [Reconstruction([1, 2, 3, 4, 5, 6], chain)])
    monkeypatch.setattr(mapping, "adjusted", lambda project, model: model)
    project: Any = SimpleNamespace(config=SfmConfig(mapper="incremental", focal=focal))
    lines: list[str] = []
    assert (mapping.find_poses(project, graph(CHAIN), lines.append) is not None) == real
    assert [f"{sides:.2g} sides" in line for line in lines[1:]] == ([] if real else [True])


def test_two_photos_are_no_reconstruction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "run_mapper", lambda *_: [Reconstruction([1, 2, 3], shared(20, 1, 2))])
    monkeypatch.setattr(mapping, "adjusted", lambda project, model: model)
    project: Any = SimpleNamespace(config=SfmConfig(mapper="incremental"))
    lines: list[str] = []
    assert mapping.find_poses(project, graph(CHAIN), lines.append) is None
    assert lines == ["incremental mapping placed 3 of 6 photos"]
    monkeypatch.setattr(mapping, "run_mapper", lambda *_: [])
    assert mapping.find_poses(project, graph(CHAIN), lines.append) is None
    assert lines[1:] == ["incremental mapping placed no photo"]


def test_few_photos_are_mapped_with_the_lens_held(tmp_path: Path) -> None:
    """Of a lens that may move with four photos a wrong pose makes what it needs."""

    class Options(SimpleNamespace):
        def __init__(self) -> None:
            super().__init__(mapper=SimpleNamespace(), triangulation=SimpleNamespace())

    ran: list[Any] = []

    def incremental(database: Path, photos: Path, target: Path, *, options: Any, input_path: object) -> dict[int, Any]:
        ran.append((options, input_path, database.read_text()))
        assert list(target.iterdir()) == [database]
        database.write_text("written to")
        models = {2: Reconstruction([1, 2, 3], shared(20, 1, 2, 3)), 1: Reconstruction([1, 2, 3], shared(20, 1, 2))}
        return {**models, 0: Reconstruction([4, 5, 6], shared(15, 4, 5, 6))}

    colmap = SimpleNamespace(
        IncrementalPipelineOptions=Options, incremental_mapping=incremental, set_random_seed=lambda seed: None
    )
    project: Any = SimpleNamespace(
        pycolmap=colmap, config=SfmConfig(seed=5), database=tmp_path / "a.db", photos=tmp_path
    )
    project.database.write_text("features")
    for first in (None, (3, 4)):
        models = few_photos._mapped(project, first)
        assert [model.photos for model in models] == [{4, 5, 6}, {1, 2, 3}]
        options, start, copied = ran[-1]
        assert (start, copied) == ("", "features")
        assert list(tmp_path.iterdir()) == [project.database]
        assert project.database.read_text() == "features"
        held = (options.ba_refine_focal_length, options.ba_refine_extra_params, options.multiple_models)
        assert held == (False, False, False)
        assert not options.structure_less_registration_fallback
        assert not options.mapper.abs_pose_refine_focal_length
        assert not options.mapper.abs_pose_refine_extra_params
        assert not options.triangulation.ignore_two_view_tracks
        assert (options.min_num_matches, options.mapper.init_min_num_inliers) == (18, 18)
        assert (options.mapper.abs_pose_min_num_inliers, options.num_threads, options.random_seed) == (15, 1, 5)
        assert (options.mapper.init_min_tri_angle, options.mapper.abs_pose_min_inlier_ratio) == (6.0, 0.25)
        assert getattr(options, "init_image_id1", None) == (first and first[0])
        assert getattr(options, "init_image_id2", None) == (first and first[1])
        assert getattr(options, "init_num_trials", None) == (first and 1)


@pytest.mark.parametrize(("focal", "free"), [(None, True), (900.0, False)])
def test_a_focal_length_that_is_known_is_kept(focal: float | None, free: bool) -> None:
    project: Any = SimpleNamespace(
        pycolmap=SimpleNamespace(IncrementalPipelineOptions=SimpleNamespace), config=SfmConfig(focal=focal, seed=3)
    )
    options = mapping.incremental_options(project)
    assert (options.ba_refine_focal_length, options.min_model_size) == (free, 3)
    assert (options.num_threads, options.random_seed) == (1, 3)


def test_names_are_those_of_the_photos_with_a_pose() -> None:
    assert mapping.registered(Reconstruction([3, 1], [])) == {"1.jpg", "3.jpg"} <= set(NAMES)


@pytest.mark.parametrize(("count", "grows"), [(None, False), (3, False), (4, True)])
def test_a_reconstruction_that_grew_by_a_photo_is_taken(
    count: int | None, grows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It begins from the exact points and lens, in an empty folder, and only the missing photos are matched again."""

    class Written(Reconstruction):
        def write(self, folder: Path) -> None:
            assert list(folder.iterdir()) == []
            (folder / "points3D.bin").touch()

    verified: list[Any] = []
    monkeypatch.setattr(few_photos, "verify", lambda project, pairs, model, only: verified.append(only))
    found = [] if count is None else [Reconstruction(list(range(1, count + 1)), [])]
    monkeypatch.setattr(
        few_photos, "_mapped", lambda project, first, start: found if first is None and any(start.iterdir()) else []
    )
    monkeypatch.setattr(few_photos, "bundle_adjusted", lambda project, model, lens: (model, lens))
    monkeypatch.setattr(few_photos, "with_guided_matches", lambda project, pairs, model: ("guided", model))
    project: Any = SimpleNamespace(database=tmp_path / "a.db")
    pairs: Any = SimpleNamespace(names={1: "a", 2: "b", 3: "c", 4: "d", 5: "e"})
    model = Written([1, 2, 3], [])
    for _ in range(2):
        grown: Any = few_photos._grown(project, pairs, model)
        assert grown == (("guided", (found[0], False)) if grows else model)
    assert verified == [{4, 5}] * 2


@pytest.mark.parametrize(("known", "focals"), [([True, True], [None]), ([True, False], [1.2, 1.9, 0.75])])
def test_focal_lengths_are_tried_where_one_is_not_known(known: list[bool], focals: list[float | None]) -> None:
    class Database:
        def __enter__(self) -> Database:
            return self

        def __exit__(self, *_: object) -> None: ...

        def read_all_cameras(self) -> list[Any]:
            return [SimpleNamespace(has_prior_focal_length=one) for one in known]

    project: Any = SimpleNamespace(opened=Database)
    assert focals_to_try(project) == focals


def test_mapping_starts_from_the_five_best_pairs_too_and_the_best_result_is_adjusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    project: Any = SimpleNamespace(config=SfmConfig(threads=1))
    pairs: Any = None
    counts = {(1, 2): 50, (1, 3): 90, (2, 3): 90, (1, 4): 10, (2, 4): 20, (3, 4): 70}
    starts: list[Any] = []

    def mapped(project: object, first: tuple[int, int] | None) -> list[Reconstruction]:
        starts.append(first)
        return [Reconstruction([1, 2, 3], shared(30 if first == (1, 2) else 20, 1, 2, 3))]

    monkeypatch.setattr(few_photos, "verify", lambda project, pairs, focal: {} if focal == 1.9 else counts)
    monkeypatch.setattr(few_photos, "_mapped", mapped)
    monkeypatch.setattr(few_photos, "bundle_adjusted", lambda project, model, lens: (model, lens))
    attempts = list(few_photos._attempts(project, pairs, "the masks", [1.2, 1.9]))
    assert starts == [None, (1, 3), (2, 3), (3, 4), (1, 2), (2, 4), None]
    assert [attempt.hypothesis for attempt in attempts] == ["the masks"] * 2
    model, lens = attempts[0].reconstruction
    assert (len(model.all_points), lens) == (30, False)
    monkeypatch.setattr(few_photos, "_mapped", lambda project, first: [])
    assert list(few_photos._attempts(project, pairs, "", [None])) == []


class Pairs:
    """The part of COLMAP's database that holds the geometry of pairs."""

    def __init__(self) -> None:
        self.geometries: dict[tuple[int, int], Any] = {(1, 9): "old"}

    def __enter__(self) -> Pairs:
        return self

    def __exit__(self, *_: object) -> None: ...

    def clear_two_view_geometries(self) -> None:
        self.geometries.clear()

    def read_all_images(self) -> list[Any]:
        return [SimpleNamespace(image_id=i, camera_id=1) for i in (1, 2, 3)]

    def exists_two_view_geometry(self, a: int, b: int) -> bool:
        return (a, b) in self.geometries

    def delete_two_view_geometry(self, a: int, b: int) -> None:
        del self.geometries[a, b]

    def write_two_view_geometry(self, a: int, b: int, found: Any) -> None:
        assert (a, b) not in self.geometries, "COLMAP refuses a second one"
        self.geometries[a, b] = found


@pytest.mark.parametrize("features", ["sift", "both"])
def test_pairs_are_kept_with_enough_in_common_and_where_their_turn_agrees(
    features: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """17 of 18 features do not suffice, nor do 99 without a pose; of learned ones a pair that turns otherwise goes."""
    counts = {(1, 2): 18, (1, 3): 30, (2, 3): 17, (3, 1): 99}

    def geometry(first: Any, points: Any, second: Any, others: Any, rows: Any, options: Any) -> Any:
        pose = None if len(rows) == 99 else SimpleNamespace(rotation=SimpleNamespace(matrix=lambda: "turn"))
        return SimpleNamespace(inlier_matches=rows[: options.min_num_inliers + 12], cam2_from_cam1=pose)

    options = SimpleNamespace(ransac=SimpleNamespace())
    colmap = SimpleNamespace(TwoViewGeometryOptions=lambda: options, estimate_calibrated_two_view_geometry=geometry)
    database, asked = Pairs(), []
    monkeypatch.setattr(few_photos, "_lenses", lambda *_: {1: "lens"})
    monkeypatch.setattr(few_photos, "disagreeing", lambda *found: asked.append(found) or [(1, 3)])
    project: Any = SimpleNamespace(pycolmap=colmap, config=SfmConfig(features=features), opened=lambda: database)
    matches = {pair: [0] * count for pair, count in counts.items()}
    pairs: Any = SimpleNamespace(matches=matches, keypoints={1: "a", 2: "b", 3: "c"}, turntable=True)
    learned = features == "both"
    found = few_photos.verify(project, pairs)
    assert found == ({(1, 2): 18} if learned else {(1, 2): 18, (1, 3): 30})
    assert database.geometries.keys() == found.keys()
    assert len(asked) == learned
    assert not learned or asked[0][2] == few_photos.MIN_TURN
    assert (options.compute_relative_pose, options.detect_watermark, options.ransac.random_seed) == (True, False, 0)
    database.geometries[1, 2] = "before"
    only = few_photos.verify(project, pairs, only={2})
    assert only == {(1, 2): 18}
    assert database.geometries.keys() == found.keys()
    assert database.geometries[1, 2] != "before"
