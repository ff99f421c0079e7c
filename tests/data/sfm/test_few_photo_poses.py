"""Few photos: the background of a turntable, matches along epipolar lines, and which reconstruction is trusted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

import pycolmap

from gsopt.data.sfm import diagnosis, few_photos
from gsopt.data.sfm.guided_matches import fundamental_matrix, guided
from gsopt.data.sfm.pair_matches import PairMatches, without_background

SIZE, FOCAL = (800, 600), 900.0
OBJECT_POINTS, WALL_POINTS = 80, 120


def rotation(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def projected(points: np.ndarray) -> np.ndarray:
    """Pixels of points in the frame of a camera 4 in front of the world's origin."""
    seen = points + np.array([0, 0, 4.0])
    return FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2


def photos(wall_turns: bool, count: int = 4, step: float = 20.0) -> PairMatches:
    """An object that turns before a wall, which turns with it where a camera walks around both."""
    drawn = np.random.default_rng(0)
    thing = drawn.uniform(-0.6, 0.6, (OBJECT_POINTS, 3))
    wall = np.column_stack([drawn.uniform(-2.5, 2.5, WALL_POINTS), drawn.uniform(-1.8, 1.8, WALL_POINTS)])
    wall = np.column_stack([wall, drawn.uniform(1.5, 2.0, WALL_POINTS)])
    keypoints = {}
    for i in range(count):
        turn = rotation(step * i).T
        seen = np.concatenate([thing @ turn, wall @ turn if wall_turns else wall])
        keypoints[i + 1] = projected(seen) + drawn.normal(0, 0.3, (len(seen), 2))
    rows = np.repeat(np.arange(OBJECT_POINTS + WALL_POINTS, dtype=np.uint32)[:, None], 2, axis=1)
    pairs = {(a, b): rows for a in keypoints for b in keypoints if a < b}
    return PairMatches({i: f"{i}.jpg" for i in keypoints}, dict.fromkeys(keypoints, SIZE), keypoints, pairs)


def test_of_an_object_on_a_turntable_the_background_is_left_out() -> None:
    moving = without_background(pycolmap, photos(wall_turns=False), seed=0)
    assert moving is not None
    for rows in moving.matches.values():
        assert (rows[:, 0] >= OBJECT_POINTS).sum() == 0
        assert (rows[:, 0] < OBJECT_POINTS).sum() > 0.6 * OBJECT_POINTS  # its axis stands still too


def test_of_an_object_that_turned_a_little_the_object_is_kept() -> None:
    """Between two neighbors the object, with more features than the wall, moves hardly more than the wall does."""
    shown = photos(wall_turns=False, count=6, step=6.0)
    few = {pair: rows[: OBJECT_POINTS + 20] if pair[1] == pair[0] + 1 else rows for pair, rows in shown.matches.items()}
    shaken = {n: points + np.array([12.0 * (n % 3), 0]) for n, points in shown.keypoints.items()}
    moving = without_background(pycolmap, replace(shown, keypoints=shaken, matches=few), seed=0, jointly=True)
    assert moving is not None
    for rows in moving.matches.values():
        assert (rows[:, 0] >= OBJECT_POINTS).sum() == 0


def test_a_camera_that_walks_has_no_background_at_rest() -> None:
    assert without_background(pycolmap, photos(wall_turns=True), seed=0) is None


def test_a_partner_on_the_epipolar_line_is_found_where_the_whole_photo_has_doubles() -> None:
    """Every descriptor occurs twice in the second photo, once far from the line: no ratio test passes there."""
    drawn = np.random.default_rng(1)
    points = drawn.uniform(-0.6, 0.6, (40, 3))
    relative = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation(30.0)), np.array([-2.0, 0.1, 0.5]))
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, *SIZE)
    first = points + np.array([0, 0, 4.0])
    second = first @ relative.rotation.matrix().T + relative.translation
    pixels = [FOCAL * seen[:, :2] / seen[:, 2:] + np.array(SIZE) / 2 for seen in (first, second)]
    fundamental = fundamental_matrix(relative, camera, camera)
    looks = drawn.normal(size=(40, 128)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    doubled = np.concatenate([pixels[1], pixels[1] + np.array([0.0, 150.0])])
    rows = guided(fundamental, pixels[0], doubled, looks, np.concatenate([looks, looks]), limit=2.0)
    assert rows.tolist() == [[i, i] for i in range(40)]


def test_a_blurred_photo_is_named_also_where_it_was_placed() -> None:
    thumbnail = np.random.default_rng(0).uniform(0, 255, (32, 32)).astype(np.float32)
    sharp = diagnosis.Photo("0.jpg", None, None, 800, 600, "camera", None, 1.0, False, thumbnail)  # type: ignore[arg-type]
    names = [f"{i}.jpg" for i in range(4)]
    shown = [replace(sharp, name=name) for name in names]
    shown[2] = replace(sharp, name="2.jpg", sharpness=0.1)
    advice = diagnosis.explain(shown, [], diagnosis.ViewGraph({}, {}, frozenset()), set(names)).advice
    assert [text for text in advice if "blurred" in text] == [
        "2.jpg is placed but blurred: the splats learn its blur. Take it again, or leave it out."
    ]


@pytest.mark.parametrize("size", [(400, 300), (300, 400)])
def test_a_focal_length_that_is_tried_is_a_multiple_of_the_longer_side_without_distortion(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    database = tmp_path / "photos.db"
    project = SimpleNamespace(pycolmap=pycolmap)
    with pycolmap.Database.open(database) as db:
        known = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 123.0, *size)
        known.has_prior_focal_length = True
        unknown = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 50.0, *size)
        unknown.params = [50.0, 1.0, 2.0, 0.3]
        numbers = [db.write_camera(known), db.write_camera(unknown)]
        lenses = few_photos._lenses(project, db, None, 1.2)
        for lens in (lenses[numbers[1]], db.read_camera(numbers[1])):
            assert list(lens.params) == [1.2 * 400, size[0] / 2, size[1] / 2, 0.0]
            assert lens.has_prior_focal_length
        model = SimpleNamespace(cameras={numbers[1]: known})
        assert few_photos._lenses(project, db, model, 1.2)[numbers[1]] is known
        before = few_photos._lenses(project, db, None, None)
        assert before[numbers[1]].params[0] == 480.0
