"""Matches along epipolar lines are written for photos that look the same way, and points are made from them anew."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsopt.data.sfm import guided_matches
from gsopt.data.sfm.pair_matches import PairMatches
from gsopt.data.sfm.settings import SfmConfig

pycolmap = pytest.importorskip("pycolmap")

SIZE = (400, 300)
COUNT = 20
POINTS = np.random.default_rng(0).uniform(-1, 1, (COUNT, 3))


class Database(SimpleNamespace):
    """The database keeps all that is written, in order."""

    def __enter__(self) -> Database:
        self.written: list[Any] = []
        return self

    def __exit__(self, *_: object) -> None: ...

    def clear_two_view_geometries(self) -> None:
        self.written.append("cleared")

    def write_two_view_geometry(self, a: int, b: int, geometry: Any) -> None:
        self.written.append((a, b, geometry))


def cameras(*degrees: float, roll: float = 0.0) -> Any:
    """Cameras at rest above the points, turned around them; the focal length is 300 px. The last one is rolled too."""
    made = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model="PINHOLE", width=400, height=300, params=[300.0, 300, 200, 150], camera_id=1)
    made.add_camera_with_trivial_rig(lens)
    for number, angle in enumerate(np.radians(degrees), 1):
        turn = pycolmap.Rotation3d(np.array([0, angle, 0]))
        if number == len(degrees):
            turn = pycolmap.Rotation3d(np.array([0, 0, np.radians(roll)])) * turn
        pose = pycolmap.Rigid3d(turn, np.array([0.0, 0, 5]))
        image = pycolmap.Image(name=f"{number}.png", camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
    return made


def seen(made: Any, matches: dict[tuple[int, int], np.ndarray]) -> PairMatches:
    """The points in all photos, exactly where these cameras see them."""
    keypoints = {}
    for number in made.reg_image_ids():
        local = POINTS @ made.image(number).cam_from_world().rotation.matrix().T + [0, 0, 5]
        keypoints[number] = 300 * local[:, :2] / local[:, 2:] + [200, 150]
    names = {number: f"{number}.png" for number in keypoints}
    return PairMatches(names, dict.fromkeys(names, SIZE), keypoints, matches)


def written(made: Any, pairs: PairMatches, descriptors: dict[int, np.ndarray], band: float = 0.006) -> list[Any]:
    database = Database()
    project: Any = SimpleNamespace(pycolmap=pycolmap, opened=lambda: database)
    guided_matches._write_guided(project, pairs, made, descriptors, band)
    return database.written


@pytest.mark.parametrize("roll", [0, 90, 180])
@pytest.mark.parametrize(("turn", "compared"), [(59.9, True), (60.5, False), (-59.9, True), (-60.5, False)])
def test_photos_that_look_up_to_sixty_degrees_apart_are_matched_with_their_true_geometry(
    turn: float, roll: float, compared: bool
) -> None:
    """All points look different, and each finds itself; what was verified before is forgotten. A photo on its side or
    on its head shows the same."""
    made = cameras(0, turn, roll=roll)
    looks = dict.fromkeys((1, 2), np.eye(128, dtype=np.float32)[:COUNT])
    first, *found = written(made, seen(made, {}), looks)
    assert first == "cleared"
    assert [pair[:2] for pair in found] == [(1, 2)] * compared
    for _, _, geometry in found:
        assert geometry.inlier_matches.tolist() == [[row, row] for row in range(COUNT)]
        assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        relative = made.image(2).cam_from_world() * made.image(1).cam_from_world().inverse()
        np.testing.assert_allclose(geometry.cam2_from_cam1.matrix(), relative.matrix())
        np.testing.assert_allclose(geometry.E, pycolmap.essential_matrix_from_pose(relative))


@pytest.mark.parametrize(("count", "kept"), [(18, 18), (17, 0)])
def test_photos_of_other_sides_keep_the_matches_that_they_had(count: int, kept: int) -> None:
    """A partner is not looked for there."""
    made = cameras(0, 90)
    earlier = {(1, 2): np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)}
    looks = dict.fromkeys((1, 2), np.eye(128, dtype=np.float32)[:COUNT])
    found = written(made, seen(made, earlier), looks)[1:]
    assert [len(geometry.inlier_matches) for _, _, geometry in found] == [kept] * (kept > 0)


def test_every_pair_of_placed_photos_is_matched_once() -> None:
    made = cameras(0, 20, 40)
    looks = dict.fromkeys((1, 2, 3), np.eye(128, dtype=np.float32)[:COUNT])
    assert [pair[:2] for pair in written(made, seen(made, {}), looks)[1:]] == [(1, 2), (1, 3), (2, 3)]


@pytest.mark.parametrize(("off", "found"), [(2.9, True), (3.1, False)])
def test_a_partner_lies_within_a_share_of_the_diagonal_of_the_first_photo(off: float, found: bool) -> None:
    """0.6 % of 500 px are 3 px. The epipolar lines of a turn about the vertical through the middle are level there."""
    made = cameras(0, 20)
    pairs = seen(made, {})
    pairs.keypoints[1][:], pairs.keypoints[2][:] = (200, 150), (200, 150)
    pairs.keypoints[2][:, 1] += off
    pairs.sizes[2] = (4000, 3000)
    looks = dict.fromkeys((1, 2), np.eye(128, dtype=np.float32)[:COUNT])
    assert len(written(made, pairs, looks)[1:]) == found


def test_a_single_match_is_written_and_features_without_a_description_are_not_matched() -> None:
    """Learned features come after those that have one; an earlier match of theirs stays."""
    made = cameras(0, 20)
    looks = {1: np.eye(128, dtype=np.float32)[:1], 2: np.eye(128, dtype=np.float32)[:1]}
    ((_, _, geometry),) = written(made, seen(made, {}), looks)[1:]
    assert geometry.inlier_matches.tolist() == [[0, 0]]
    none = dict.fromkeys((1, 2), np.zeros((0, 128), np.float32))
    assert written(made, seen(made, {}), none) == ["cleared"]
    earlier = {(1, 2): np.array([[7, 7]], np.uint32)}
    ((_, _, geometry),) = written(made, seen(made, earlier), none)[1:]
    assert geometry.inlier_matches.tolist() == [[7, 7]]
    ((_, _, geometry),) = written(made, seen(made, earlier), looks)[1:]
    assert geometry.inlier_matches.tolist() == [[7, 7], [0, 0]]


def test_earlier_matches_are_measured_in_pixels_from_lines_of_any_length() -> None:
    """A fundamental matrix has no scale, and no row of matches is as good as none."""
    keypoints = {1: np.array([[0.0, 10], [0, 20]]), 2: np.array([[9.0, 11.9], [9, 22.1]])}
    rows = np.array([[0, 0], [1, 1]], np.uint32)
    pairs = PairMatches({1: "", 2: ""}, {}, keypoints, {(1, 2): rows, (2, 1): rows[:0]})
    level = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    new = np.array([[1, 0]], np.uint32)
    for scale in (1e-3, 1.0, 40.0):
        found = guided_matches._with_verified(new[:0], pairs, (1, 2), scale * level, 2.0)
        assert found.tolist() == [[0, 0]]
    assert guided_matches._with_verified(new, pairs, (2, 1), level, 2.0) is new
    assert guided_matches._with_verified(new, pairs, (1, 2), level, 2.0).tolist() == [[0, 0]]


def test_descriptors_have_unit_length_and_are_absent_where_a_photo_has_none() -> None:
    rows = np.zeros((2, 128), np.uint8)
    rows[0, :2] = 3, 4
    database = Database(
        exists_descriptors=lambda number: number == 1, read_descriptors=lambda number: SimpleNamespace(data=rows)
    )
    pairs = PairMatches({1: "a", 2: "b"}, {}, {}, {})
    project: Any = SimpleNamespace(opened=lambda: database)
    found = guided_matches._descriptors(project, pairs)
    assert found[1][0, :3].tolist() == pytest.approx([0.6, 0.8, 0])
    assert found[1][1].tolist() == [0] * 128
    assert found[2].shape == (0, 128)
    assert math.isclose(float(np.linalg.norm(found[1][0])), 1, rel_tol=1e-6)


def test_points_are_made_anew_from_all_matches_and_the_poses_adjusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lens stays; points of two photos count too. The model that was given is not touched."""
    done: list[Any] = []

    class Model:
        bare = False

        def delete_all_points2D_and_points3D(self) -> None:
            self.bare = True

    def triangulate(bare: Model, database: Path, photos: Path, target: Path, **how: Any) -> str:
        done.append((bare.bare, list(target.iterdir()), how["refine_intrinsics"], how["options"].triangulation))
        return "triangulated"

    def adjusted(project: Any, model: Any, *, lens: bool) -> tuple[Any, bool]:
        return model, lens

    given = Model()
    monkeypatch.setattr(guided_matches, "_descriptors", lambda project, pairs: "descriptors")
    monkeypatch.setattr(guided_matches, "_write_guided", lambda *asked: done.append(asked[1:]))
    monkeypatch.setattr(guided_matches, "bundle_adjusted", adjusted)
    colmap = SimpleNamespace(
        triangulate_points=triangulate, IncrementalPipelineOptions=pycolmap.IncrementalPipelineOptions
    )
    project: Any = SimpleNamespace(
        pycolmap=colmap, config=SfmConfig(), database=tmp_path / "database.db", photos=tmp_path
    )
    for _ in range(2):
        pairs: Any = "pairs"
        assert guided_matches.with_guided_matches(project, pairs, given) == ("triangulated", False)
        assert not given.bare
        matched, (bare, left, refined, triangulation) = done
        assert matched == ("pairs", given, "descriptors", 0.006)
        assert (bare, left, refined, triangulation.ignore_two_view_tracks) == (True, [], False, False)
        (tmp_path / "guided" / "left over").touch()
        done.clear()


def test_a_feature_is_taken_in_its_own_photo_whatever_its_number_in_the_other_one() -> None:
    keypoints = {n: np.stack([np.zeros(4), np.arange(4.0) + 100 * (n == 2)], 1) for n in (1, 2)}
    keypoints[2][1] = keypoints[1][0]
    pairs = PairMatches({1: "", 2: ""}, {}, keypoints, {(1, 2): np.array([[0, 1]], np.uint32)})
    level = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    new = np.array([[0, 3], [1, 2], [2, 0], [3, 1]], np.uint32)
    found = guided_matches._with_verified(new, pairs, (1, 2), level, 2.0)
    assert found.tolist() == [[0, 1], [1, 2], [2, 0]]


@pytest.mark.parametrize("at_once", [1, 7, 10**6])
def test_partners_are_mutual_whatever_is_compared_at_once(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Feature n of one photo is 39 - n of the other. Two equal ones (0 and 1) share a partner, and one has it."""
    looks = np.abs(np.random.default_rng(3).normal(size=(40, 128))).astype(np.float32) ** 3
    looks[1] = looks[0]
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    points = np.stack([np.arange(40.0), np.full(40, 10.0)], axis=1)
    level = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    monkeypatch.setattr(guided_matches, "ROWS_AT_ONCE", at_once)
    found = guided_matches.guided(level, points, points[:39], looks, looks[::-1][:39], 2.0)
    assert found.tolist() == [[0, 38], *([n, 39 - n] for n in range(2, 40))]
