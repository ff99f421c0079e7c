"""Matches over three photos: what a repeated pattern pretends is dropped, and what all photos agree on stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsopt.data.sfm.consistent_matches import consistent, disagreeing, on_epipolar_lines
from gsopt.data.sfm.pair_matches import PairMatches

SIZE = (1000, 800)
POINTS, PERIOD = 60, 90.0
PHOTOS = (1, 2, 3, 4)


def walked(seed: int = 0) -> PairMatches:
    """Points seen by four photos, each at its own place, with feature i of every photo the same point."""
    drawn = np.random.default_rng(seed)
    places = drawn.uniform([100, 50], [700, 750], (POINTS, 2))
    depth = drawn.uniform(20, 60, POINTS)
    keypoints = {n: places + np.outer(depth, (n, 0.2 * n)) * 0.9 + drawn.normal(0, 0.3, (POINTS, 2)) for n in PHOTOS}
    rows = np.repeat(np.arange(POINTS, dtype=np.uint32)[:, None], 2, axis=1)
    matches = {(a, b): rows for a in PHOTOS for b in PHOTOS if a < b}
    return PairMatches({n: f"{n}.jpg" for n in PHOTOS}, dict.fromkeys(PHOTOS, SIZE), keypoints, matches)


def shifted(rows: np.ndarray, by: int) -> np.ndarray:
    """Every feature matched with the one that stands `by` repeats further on."""
    return np.column_stack([rows[:, 0], (rows[:, 1] + by) % POINTS]).astype(np.uint32)


def test_true_tracks_stay() -> None:
    pairs = walked()
    kept = consistent(pairs)
    assert {pair: rows.tolist() for pair, rows in kept.matches.items()} == {
        pair: rows.tolist() for pair, rows in pairs.matches.items()
    }


@pytest.mark.parametrize("wrong", [(1, 4), (1, 2), (2, 4)])
def test_a_repeated_pattern_that_is_wrong_by_one_repeat_is_dropped(wrong: tuple[int, int]) -> None:
    pairs = walked()
    pairs = replace(pairs, matches={**pairs.matches, wrong: shifted(pairs.matches[wrong], 1)})
    kept = consistent(pairs)
    assert len(kept.matches.get(wrong, ())) == 0
    assert all(len(rows) == POINTS for pair, rows in kept.matches.items() if pair != wrong)


def test_single_matches_that_a_third_photo_contradicts_are_dropped() -> None:
    pairs = walked()
    rows = pairs.matches[1, 3].copy()
    rows[:6, 1] = np.roll(rows[:6, 1], 2)
    kept = consistent(replace(pairs, matches={**pairs.matches, (1, 3): rows}))
    assert sorted(kept.matches[1, 3][:, 0].tolist()) == list(range(6, POINTS))
    assert len(kept.matches[1, 2]) == len(kept.matches[2, 3]) == POINTS


def test_detectors_that_place_a_feature_a_little_apart_do_not_contradict_each_other() -> None:
    pairs = walked()
    doubled = np.concatenate([pairs.keypoints[3], pairs.keypoints[3] + 2.0])
    rows = pairs.matches[1, 3] + np.array([0, POINTS], np.uint32)
    pairs = replace(pairs, keypoints={**pairs.keypoints, 3: doubled}, matches={**pairs.matches, (1, 3): rows})
    assert all(len(rows) == POINTS for rows in consistent(pairs).matches.values())


def test_a_few_votes_do_not_condemn_a_pair_with_many_matches() -> None:
    """Chance matches of two photos from opposite sides contradict a handful of the right ones."""
    pairs = walked()
    chance = shifted(pairs.matches[1, 4], 7)[:9]
    pairs = replace(pairs, matches={**pairs.matches, (1, 4): chance})
    kept = consistent(pairs)
    assert len(kept.matches.get((1, 4), ())) == 0
    assert len(kept.matches[1, 2]) == len(kept.matches[2, 4]) == POINTS


def test_two_photos_alone_are_left_as_they_are() -> None:
    pairs = walked()
    pairs = replace(pairs, matches={(1, 2): pairs.matches[1, 2], (3, 4): pairs.matches[3, 4][:0]})
    assert len(consistent(pairs).matches[1, 2]) == POINTS
    assert len(consistent(replace(pairs, matches={})).matches) == 0


def test_matches_off_the_epipolar_lines_have_no_vote() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    pairs = walked()
    rows = pairs.matches[1, 2].copy()
    rows[:15, 1] = np.roll(rows[:15, 1], 4)
    kept = on_epipolar_lines(pycolmap, replace(pairs, matches={(1, 2): rows, (2, 3): rows[:10]}), seed=0)
    assert set(range(15, POINTS)) <= set(kept.matches[1, 2][:, 0].tolist())
    assert (kept.matches[1, 2][:, 0] < 15).sum() < 5
    assert len(kept.matches[2, 3]) == 0


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_a_pair_that_turns_otherwise_than_the_way_around_is_left_out() -> None:
    counts = {(1, 2): 500, (2, 3): 400, (3, 4): 300, (1, 3): 250, (1, 4): 200, (2, 4): 90}
    turns = {(a, b): turn(30.0 * (b - a)) for a, b in counts}
    assert disagreeing(counts, turns) == []
    turns[1, 4] = turn(20.0)  # 90 degrees apart, and a repeated pattern says 20
    turns[2, 4] = turn(65.0)  # right, save for what few matches leave open
    assert disagreeing(counts, turns) == [(1, 4)]


def test_where_there_is_no_way_around_nothing_is_left_out() -> None:
    assert disagreeing({(1, 2): 20, (3, 4): 30}, {(1, 2): turn(170.0), (3, 4): turn(5.0)}) == []


def test_on_a_turntable_what_does_not_turn_is_left_out() -> None:
    turns = {(1, 2): turn(40.0), (2, 3): turn(2.0)}
    assert disagreeing({(1, 2): 50, (2, 3): 90}, turns, least=6.0) == [(2, 3)]
