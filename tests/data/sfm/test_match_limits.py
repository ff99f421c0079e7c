"""Limits of matches and of what surrounds COLMAP, met exactly and passed, with stand-ins for its estimators."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsopt.data.lens import Lens
from gsopt.data.sfm import (
    consistent_matches,
    guided_matches,
    joined_features,
    pair_matches,
    placement,
    retrieval,
)
from gsopt.data.sfm.consistent_matches import Votes, disagreeing, votes_of
from gsopt.data.sfm.guided_matches import fundamental_matrix, guided
from gsopt.data.sfm.pair_matches import PairMatches
from gsopt.data.sfm.write_scene import _frame, transforms


def options() -> Any:
    return SimpleNamespace()


def estimator(homography: np.ndarray, inliers: np.ndarray | None = None) -> tuple[Any, list[Any]]:
    """A stand-in for pycolmap that finds this homography, and what it was asked."""
    asked: list[Any] = []

    def estimate(first: np.ndarray, second: np.ndarray, given: Any) -> dict[str, Any]:
        asked.append((len(first), given))
        mask = np.ones(len(first), bool) if inliers is None else inliers[: len(first)]
        return {"num_inliers": int(mask.sum()), "H": homography, "inlier_mask": mask}

    return SimpleNamespace(RANSACOptions=options, estimate_homography_matrix=estimate), asked


def spread(count: int, across: float = 0.9, down: float = 0.9) -> np.ndarray:
    """Points of a photo of 300 x 400 px that span these shares of it."""
    line = np.linspace(0, 1, count)
    return np.column_stack([10 + across * 300 * line, 10 + down * 400 * line[::-1]])


DIAGONAL = 500.0


@pytest.mark.parametrize(
    ("count", "span", "found"),
    [
        (12, (0.9, 0.9), True),
        (11, (0.9, 0.9), False),
        (12, (0.51, 0.9), True),
        (12, (0.49, 0.9), False),
        (12, (0.9, 0.49), False),
    ],
)
def test_a_background_at_rest_is_twelve_matches_over_half_the_picture(
    count: int, span: tuple[float, float], found: bool
) -> None:
    points = spread(count, *span)
    colmap, asked = estimator(np.eye(3))
    marks = pair_matches._at_rest(colmap, points, points.copy(), (300, 400), 5)
    assert marks.tolist() == [found] * count
    if count >= 12:
        ((number, given),) = asked
        assert (number, given.random_seed, given.max_num_trials) == (count, 5, 3000)
        assert given.max_error == pytest.approx(0.012 * DIAGONAL)


@pytest.mark.parametrize(("share", "found"), [(0.149, True), (0.151, False)])
def test_a_background_at_rest_moves_its_corners_by_less_than_a_seventh(share: float, found: bool) -> None:
    points = spread(20)
    homography = np.eye(3)
    homography[0, 2] = share * DIAGONAL
    marks = pair_matches._at_rest(estimator(homography)[0], points, points.copy(), (300, 400), 0)
    assert marks.any() == found
    homography *= 2  # the same for a plane at any scale
    assert pair_matches._at_rest(estimator(homography)[0], points, points.copy(), (300, 400), 0).any() == found
    turned = np.diag([1.0, 1.0, 1.0])
    turned[2, 0] = 1e-3  # a plane that is turned away: its right corners move
    right = max(abs(300 / 1.3 - 300), abs(400 / 1.3 - 400))
    assert right > 0.15 * DIAGONAL
    assert not pair_matches._at_rest(estimator(turned)[0], points, points.copy(), (300, 400), 0).any()


def test_only_matches_that_hardly_move_are_asked_about_and_only_inliers_are_marked() -> None:
    points = spread(30)
    moved = points.copy()
    moved[:10] += [0.149 * DIAGONAL, 0]
    moved[10:15] += [0.151 * DIAGONAL, 0]
    inliers = np.arange(25) >= 4
    colmap, asked = estimator(np.eye(3), inliers)
    marks = pair_matches._at_rest(colmap, points, moved, (300, 400), 0)
    assert asked[0][0] == 25
    near = np.r_[0:10, 15:30]
    assert np.flatnonzero(marks).tolist() == near[inliers].tolist()
    few, _ = estimator(np.eye(3), np.arange(25) < 11)
    assert not pair_matches._at_rest(few, points, moved, (300, 400), 0).any()


def pairs_of(count: int, matches: int = 12) -> PairMatches:
    """Photos whose pairs all have so many matches."""
    numbers = range(1, count + 1)
    rows = np.stack([np.arange(matches)] * 2, axis=1).astype(np.uint32)
    return PairMatches(
        {n: f"{n}" for n in numbers},
        dict.fromkeys(numbers, (300, 400)),
        {n: spread(matches) for n in numbers},
        {(a, b): rows for a in numbers for b in numbers if a < b},
    )


@pytest.mark.parametrize(("still", "found"), [(10, True), (8, True), (7, False), (2, False)])
def test_four_of_five_pairs_must_show_a_background_at_rest(
    monkeypatch: pytest.MonkeyPatch, still: int, found: bool
) -> None:
    pairs = pairs_of(5)
    left = iter([True] * still + [False] * (10 - still))
    monkeypatch.setattr(pair_matches, "_at_rest", lambda *_: np.full(12, next(left)))
    moving = pair_matches.without_background(None, pairs, 0)
    assert (moving is not None) == found
    if moving is not None:
        assert sum(len(rows) == 0 for rows in moving.matches.values()) == still


def test_three_pairs_at_least_must_show_a_background(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_matches, "_at_rest", lambda *_: np.ones(12, bool))
    assert pair_matches.without_background(None, pairs_of(3), 0) is not None
    assert pair_matches.without_background(None, pairs_of(2), 0) is None
    assert pair_matches.without_background(None, pairs_of(3, matches=11), 0) is None


@pytest.mark.parametrize(("yes", "no", "agreement"), [(4, 4, 0.5), (3, 4, 1.0), (2, 6, 0.25), (0, 8, 0.0), (0, 7, 1.0)])
def test_eight_votes_judge_a_pair(yes: int, no: int, agreement: float) -> None:
    votes = Votes({(1, 2): np.array([yes, 0])}, {(1, 2): np.array([0, no])})
    assert votes.agreement((1, 2)) == agreement


@pytest.mark.parametrize(("apart", "confirmed"), [(0.0059, True), (0.0061, False)])
def test_two_positions_are_the_same_place_within_6_thousandths_of_the_diagonal(apart: float, confirmed: bool) -> None:
    """Feature 0 of photo 1 leads to feature 0 of photo 3 directly and to feature 1 by way of photo 2."""
    keypoints = {1: np.zeros((1, 2)), 2: np.zeros((1, 2)), 3: np.array([[0.0, 0], [apart * DIAGONAL, 0]])}
    one = np.array([[0, 0]], np.uint32)
    matches = {(1, 2): one, (2, 3): np.array([[0, 1]], np.uint32), (1, 3): one}
    votes = votes_of(PairMatches({n: "" for n in (1, 2, 3)}, dict.fromkeys((1, 2, 3), (300, 400)), keypoints, matches))
    for pair in matches:
        assert votes.confirmed[pair].tolist() == [int(confirmed)]
        assert votes.contradicted[pair].tolist() == [int(not confirmed)]


@pytest.mark.parametrize(("count", "inliers", "kept"), [(15, 15, 15), (14, 14, 0), (20, 14, 0), (20, 15, 15)])
def test_fifteen_matches_lie_on_the_epipolar_lines_of_a_pair(count: int, inliers: int, kept: int) -> None:
    asked: list[Any] = []

    def estimate(first: Any, second: Any, given: Any) -> dict[str, Any]:
        asked.append(given)
        return {"num_inliers": inliers, "inlier_mask": np.arange(len(first)) < inliers}

    colmap = SimpleNamespace(RANSACOptions=options, estimate_fundamental_matrix=estimate)
    found = consistent_matches.on_epipolar_lines(colmap, pairs_of(2, count), 9)
    assert len(found.matches[1, 2]) == kept
    for given in asked:
        assert (given.max_error, given.max_num_trials, given.random_seed) == (3.0, 5000, 9)


def turn(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(("off", "wrong"), [(19.9, []), (-19.9, []), (20.1, [(1, 3)])])
def test_a_chain_of_two_links_may_be_off_by_twenty_degrees(off: float, wrong: list[tuple[int, int]]) -> None:
    turns = {(1, 2): turn(30), (2, 3): turn(20), (1, 3): turn(50 + off)}
    assert disagreeing({(1, 2): 90, (2, 3): 80, (1, 3): 70}, turns) == wrong


@pytest.mark.parametrize(("degrees", "wrong"), [(5.9, [(1, 2)]), (6.1, [])])
def test_a_turn_below_the_least_is_none(degrees: float, wrong: list[tuple[int, int]]) -> None:
    assert disagreeing({(1, 2): 90}, {(1, 2): turn(degrees)}, least=6.0) == wrong


def unit(*parts: float) -> np.ndarray:
    row = np.zeros(128, np.float32)
    row[: len(parts)] = parts
    return row / np.linalg.norm(row)


LEVEL = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The fundamental matrix of a shift to the side: partners lie in the same row."""


@pytest.mark.parametrize(("off", "found"), [(1.9, True), (2.1, False), (-1.9, True)])
def test_a_partner_lies_within_the_limit_of_the_epipolar_line(off: float, found: bool) -> None:
    rows = guided(LEVEL, np.array([[5.0, 40]]), np.array([[90.0, 40 + off]]), unit(1)[None], unit(1)[None], 2.0)
    assert rows.tolist() == ([[0, 0]] if found else [])


@pytest.mark.parametrize(("distance", "found"), [(0.74, True), (0.76, False)])
def test_a_partner_looks_alike(distance: float, found: bool) -> None:
    cosine = 1 - distance**2 / 2
    other = unit(cosine, math.sqrt(1 - cosine**2))
    rows = guided(LEVEL, np.array([[5.0, 40]]), np.array([[90.0, 40]]), unit(1)[None], other[None], 2.0)
    assert len(rows) == int(found)


@pytest.mark.parametrize(("ratio", "found"), [(0.84, True), (0.86, False)])
def test_a_partner_looks_clearly_more_alike_than_the_next(ratio: float, found: bool) -> None:
    def at(distance: float, axis: int) -> np.ndarray:
        cosine = 1 - distance**2 / 2
        row = np.zeros(128, np.float32)
        row[0], row[axis] = cosine, math.sqrt(1 - cosine**2)
        return row

    looks = np.stack([at(0.5 * ratio, 1), at(0.5, 2)])
    places = np.array([[90.0, 40], [30, 40]])
    rows = guided(LEVEL, np.array([[5.0, 40]]), places, unit(1)[None], looks, 2.0)
    assert len(rows) == int(found)
    places[1, 1] = 80  # off the line it does not compete
    assert len(guided(LEVEL, np.array([[5.0, 40]]), places, unit(1)[None], looks, 2.0)) == 1


def test_only_mutual_partners_are_matched_and_none_where_nobody_is() -> None:
    first, second = np.array([[5.0, 40], [9, 40]]), np.array([[90.0, 40]])
    looks = np.stack([unit(1, 0.2), unit(1)])
    assert guided(LEVEL, first, second, looks, unit(1)[None], 2.0).tolist() == [[1, 0]]
    assert guided(LEVEL, first[:0], second, looks[:0], unit(1)[None], 2.0).shape == (0, 2)
    assert guided(LEVEL, first, second[:0], looks, looks[:0], 2.0).shape == (0, 2)


def test_earlier_matches_stay_where_the_poses_agree_and_take_no_feature_twice() -> None:
    keypoints = {
        1: np.array([[0.0, 10], [0, 20], [0, 30], [0, 40]]),
        2: np.array([[9.0, 11.9], [9, 22.1], [9, 30], [9, 40]]),
    }
    earlier = np.array([[0, 0], [1, 1]], np.uint32)
    pairs = PairMatches({1: "", 2: ""}, {}, keypoints, {(1, 2): earlier})
    new = np.array([[0, 3], [2, 0], [1, 2], [3, 3]], np.uint32)
    found = guided_matches._with_verified(new, pairs, (1, 2), LEVEL, 2.0)
    assert found.tolist() == [[0, 0], [1, 2], [3, 3]]
    assert guided_matches._with_verified(new, pairs, (1, 3), LEVEL, 2.0) is new


def test_the_fundamental_matrix_is_zero_for_two_images_of_a_point() -> None:
    K, L = np.array([[500.0, 0, 320], [0, 480, 240], [0, 0, 1]]), np.array([[300.0, 0, 100], [0, 310, 90], [0, 0, 1]])
    R, t = turn(20) @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]), np.array([0.3, -0.2, 0.5])
    relative = SimpleNamespace(translation=t, rotation=SimpleNamespace(matrix=lambda: R))
    first, second = (SimpleNamespace(calibration_matrix=lambda M=M: M) for M in (K, L))
    F = fundamental_matrix(relative, first, second)
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (20, 3))
    a, b = points @ K.T, (points @ R.T + t) @ L.T
    residuals = np.einsum("ni,ij,nj->n", b / b[:, 2:], F, a / a[:, 2:])
    assert np.abs(residuals).max() < 1e-12
    assert np.abs(F).max() > 1e-6


@pytest.mark.parametrize(("alike", "compared"), [(20, True), (19, False)])
def test_photos_with_twenty_lookalikes_are_compared(alike: int, compared: bool) -> None:
    features: Any = {"a": 0, "b": 1}
    assert joined_features.alike(features, lambda a, b: alike) == ([("a", "b")] if compared else [])


def test_each_photo_is_compared_with_the_six_most_like_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def like_zero(a: Any, b: Any, most: int = 9) -> int:
        return 100 - abs(a - b) if 0 in (a, b) and max(a, b) < most else 0

    features: Any = {f"{i}": i for i in range(9)}
    assert joined_features.alike(features, like_zero) == [
        ("0", f"{i}") for i in range(1, 9)
    ]  # each of them looks most like 0
    monkeypatch.setattr(joined_features, "MIN_LOOKALIKES", 94)
    assert joined_features.alike(features, partial(like_zero, most=8)) == [("0", f"{i}") for i in range(1, 7)]


@pytest.mark.parametrize(("columns", "rest"), [(6, [1, 0, 0, 1]), (4, [1, 0]), (2, [])])
def test_keypoints_are_appended_in_the_form_of_those_that_are_there(columns: int, rest: list[float]) -> None:
    before = np.full((3, columns), 7, np.float32)
    written: list[np.ndarray] = []
    db = SimpleNamespace(
        exists_keypoints=lambda number: True,
        read_keypoints=lambda number: before,
        update_keypoints=lambda number, rows: written.append(rows),
    )
    assert joined_features._append_keypoints(db, 1, np.array([[1.5, 2.5], [3, 4]])) == 3
    assert written[0].tolist() == [*before.tolist(), [1.5, 2.5, *rest], [3, 4, *rest]]
    db.exists_keypoints = lambda number: False
    db.write_keypoints = lambda number, rows: written.append(rows)
    assert joined_features._append_keypoints(db, 1, np.array([[1.5, 2.5]])) == 0
    assert written[1].tolist() == [[1.5, 2.5]]


@pytest.mark.parametrize(
    ("lens", "entries"),
    [
        (Lens(), {"camera_model": "PINHOLE"}),
        (Lens(radial=(0.1,), tangential=(0.3, 0.4)),
         {"camera_model": "OPENCV", "k1": 0.1, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0.3, "p2": 0.4}),
        (Lens(radial=(0.1, 0.2, 0.3, 0.4), fisheye=True),
         {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4, "p1": 0.0, "p2": 0.0}),
    ],
)  # fmt: skip
def test_a_frame_of_transforms_names_its_lens(lens: Lens, entries: dict[str, Any]) -> None:
    import torch

    from gsopt.data.posed_images import PosedImage

    K = torch.tensor([[50.0, 0, 20], [0, 60, 15], [0, 0, 1]], dtype=torch.float64)
    posed = PosedImage("images/a.png", Path("a"), None, torch.eye(4, dtype=torch.float64), K, 40, 30, lens, 0)
    found = _frame(posed)
    assert {key: found[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")} == {
        "w": 40, "h": 30, "fl_x": 50.0, "fl_y": 60.0, "cx": 20.0, "cy": 15.0,
    }  # fmt: skip
    assert {key: value for key, value in found.items() if key[0] in "kp" or key == "camera_model"} == entries
    moved = placement.Similarity(2.0, np.eye(3), np.array([2.0, 4, 6]))
    document = transforms([posed], moved)
    assert document["applied_scale"] == 2.0
    assert np.array(document["applied_transform"])[:, 3].tolist() == [1, 2, 3]


def test_words_are_the_means_of_what_is_nearest_to_them() -> None:
    random = np.random.default_rng(0)
    rows = np.concatenate([np.full((40, 128), level) + random.normal(0, 0.01, (40, 128)) for level in (0, 1, 5)])
    words = retrieval._words(rows.astype(np.float32), np.random.default_rng(1))
    assert words.shape == (64, 128)
    nearest = retrieval._nearest(rows.astype(np.float32), words)
    for word in np.unique(nearest):
        assert np.allclose(words[word], rows[nearest == word].mean(axis=0), atol=1e-4)
    assert len(retrieval._sampled(rows, 7, random)) == 7
    assert retrieval._sampled(rows, 120, random) is rows


def test_cameras_whose_sides_are_parallel_have_the_mean_of_their_tops_for_up() -> None:
    """Tilted up and down by different angles, all rolled by 30 degrees: their x axes fix no horizon."""
    roll, viewmats = turn(30), np.tile(np.eye(4), (5, 1, 1))
    for view, degrees in zip(viewmats, (-40, -10, 0, 5, 25), strict=True):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        view[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ roll
    tops = -viewmats[:, 1, :3].mean(axis=0)
    np.testing.assert_allclose(placement.level_up(viewmats), tops / np.linalg.norm(tops), atol=1e-6)
