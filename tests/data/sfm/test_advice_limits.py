"""Limits of advice and of retrieval that hold in sets of any sharpness and for features of any length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_answers import photo

from gsopt.data.sfm import diagnosis, retrieval


@pytest.mark.parametrize("usual", [0.02, 0.2, 1.0, 3.0])
def test_a_photo_is_blurred_below_a_quarter_of_what_is_usual_in_its_set(usual: float) -> None:
    """One that is plain is not."""
    for share, blurred in ((0.24, True), (0.26, False), (1.0, False)):
        assert diagnosis.is_blurred(photo("a.jpg", sharpness=share * usual), usual) == blurred
    plain = replace(photo("a.jpg", sharpness=0.1 * usual), thumbnail=np.full((32, 32), 100, np.float32))
    assert not diagnosis.is_blurred(plain, usual)


def test_a_gap_is_between_two_placed_photos_and_counts_those_it_lacks() -> None:
    names = ["a", "b", "c", "d", "e", "f", "g", "h"]
    assert diagnosis.gaps(names, {"b", "c", "e", "h"}) == [
        "Add photos between c and e: the one in between found no place.",
        "Add photos between e and h: the 2 in between found no place.",
    ]
    assert diagnosis.gaps(names, {"d"}) == []


def test_the_nearest_word_is_that_at_the_least_distance_not_the_longest() -> None:
    words = np.zeros((3, 128), np.float32)
    words[:, 0] = 1, 3, -2
    rows = np.zeros((5, 128), np.float32)
    rows[:, 0] = 1.9, 2.1, -0.4, -0.6, 50
    assert retrieval._nearest(rows, words).tolist() == [0, 1, 0, 2, 1]


def test_words_of_features_in_clear_groups_are_the_middles_of_the_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each group holds one of the first words; a word that nobody is near stays where it was."""
    monkeypatch.setattr(retrieval, "WORDS", 4)
    rows = np.zeros((8, 128), np.float32)
    rows[:, 0] = 0, 2, 10, 12, 20, 22, 30, 32

    class First:
        def choice(self, count: int, most: int, replace: bool) -> np.ndarray:
            return np.array([0, 2, 4, 6])

    words = retrieval._words(rows, First())  # type: ignore[arg-type]
    assert words[:, 0].tolist() == [1, 11, 21, 31]
    equal = np.zeros((8, 128), np.float32)
    assert retrieval._words(equal, First())[:, 0].tolist() == [0, 0, 0, 0]  # type: ignore[arg-type]


def test_a_sample_takes_no_row_twice_and_keeps_their_order() -> None:
    rows = np.arange(100)
    for seed in range(5):
        sample = retrieval._sampled(rows, 99, np.random.default_rng(seed))
        assert len(set(sample.tolist())) == 99
        assert sample.tolist() == sorted(sample.tolist())


def test_the_vector_of_a_photo_adds_up_what_its_features_differ_from_their_words() -> None:
    """Each word's sum has unit length, and so has all of it; none of a photo without features."""
    words = np.zeros((2, 128), np.float32)
    words[1, 0] = 10
    rows = np.zeros((3, 128), np.float32)
    rows[:, 0], rows[:, 1] = (1, 2, 10), (0, 0, 4)
    found = retrieval.vlad(rows, words).reshape(2, 128)
    half = np.sqrt(0.5)
    assert (found[0, 0], found[1, 1]) == (pytest.approx(half), pytest.approx(half))
    assert np.count_nonzero(found) == 2
    assert not retrieval.vlad(rows[:0], words).any()
