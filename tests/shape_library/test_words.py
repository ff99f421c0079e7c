"""Words and the entries that they mean."""

from __future__ import annotations

import pytest

from gsopt.shape_library.entry import Entry
from gsopt.shape_library.words import tokens, word_scores

NAMES = ["Chair", "Black table", "Bowl with fruits", "Armchair", "Dog", "Horse", "Vase", "Coffee cup", "椅子", "Стул"]
ENTRIES = [Entry(f"e{i}", name) for i, name in enumerate(NAMES)]


def first(*texts: str) -> str | None:
    """The name that the texts mean most, None when they mean none."""
    scores = word_scores(ENTRIES, texts)
    return NAMES[scores.index(max(scores))] if max(scores) > 0 else None


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("a brown chair, seen from above", "Chair"),
        ("two CHAIRS", "Chair"),
        ("an old bulldog", "Dog"),
        ("a small pony", "Horse"),
        ("a mug of tea", "Coffee cup"),
        ("an urn", "Vase"),
        ("a fruit bowl", "Bowl with fruits"),
        ("椅子", "椅子"),
        ("стул", "Стул"),
        ("a black cat", "Dog"),  # of the same line of the thesaurus; black says nothing of the kind
    ],
)
def test_words_find_their_thing(text: str, name: str) -> None:
    assert first(text) == name


@pytest.mark.parametrize(
    "text", ["", "   ", "a sea urchin", "1234 !?", "\N{CUNEIFORM SIGN A}", "the photo of a white object"]
)
def test_words_that_nothing_is_called_by_mean_nothing(text: str) -> None:
    assert first(text) is None


def test_words_without_end_are_read_as_far_as_a_note_may_be() -> None:
    assert first("chair " * 2000) == "Chair"
    assert len(tokens("x " * 100_000)) == 2000
    assert first("z" * 10_000) is None


def test_a_word_in_many_texts_says_more_than_one_in_a_single_text() -> None:
    assert first("a horse", "a vase on a stand", "a vase in blue") == "Vase"
