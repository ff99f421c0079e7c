"""Words that a shape prior knows: those of the library it learned from, found by the rules of the library."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from gsopt.shape_library.entry import Entry
from gsopt.shape_library.words import COMMON, kin, tokens

MAX_WORDS = 12
"""Words of a description that count, the first ones."""
MIN_ENTRIES = 2
"""Entries that must have a word: one entry's word would be its name."""


def words_of(entry: Entry) -> list[str]:
    """The words of an entry, those of its name first."""
    found = tokens(entry.name or entry.id) + tokens(f"{entry.category} {entry.words}")
    return [word for word in dict.fromkeys(found) if word not in COMMON]


def vocabulary_of(entries: Sequence[Entry]) -> tuple[str, ...]:
    """All words that enough entries have, in alphabetical order."""
    times = Counter(word for entry in entries for word in words_of(entry))
    return tuple(sorted(word for word, count in times.items() if count >= MIN_ENTRIES))


def encoded(words: Sequence[str], vocabulary: Sequence[str]) -> Int[Tensor, "L"]:
    """Rows of the words in the vocabulary, counted from 1; 0 fills up."""
    row = {word: i + 1 for i, word in enumerate(vocabulary)}
    rows = [row[word] for word in words if word in row][:MAX_WORDS]
    return torch.tensor(rows + [0] * (MAX_WORDS - len(rows)))


def known_words(texts: Sequence[str], vocabulary: Sequence[str]) -> tuple[list[str], list[str]]:
    """Words of the vocabulary that the texts mean, and words that mean none: a word stands for itself, else for the
    known words of its line in the thesaurus."""
    known, unknown, have = [], [], set(vocabulary)
    for word in dict.fromkeys(word for text in texts for word in tokens(text)):
        if word in COMMON:
            continue
        meant = [word] if word in have else sorted(kin(word) & have)
        known += meant
        unknown += [] if meant else [word]
    return list(dict.fromkeys(known)), unknown
