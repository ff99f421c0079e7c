"""The entries of a library that an expert's words mean: words of names, kinds of things, and a small thesaurus.

A name's last word says what the thing is ("black table", "bowl with fruits": bowl); the others only how it looks. A
word of the expert's that ends in a name's ("bulldog": dog) means a kind of it. A line of the thesaurus lists kinds of
one thing; a word in it finds the others, for less. Words that are in many names say less (inverse document
frequency).
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from gsopt.shape_library.entry import Entry

THESAURUS = Path(__file__).with_name("thesaurus.txt")
MAX_LENGTH = 4000
"""Characters of the words that are read; a category stands in the first few."""
HEAD, NAME, TOLD, AKIN, KIN = 1.0, 0.3, 0.5, 0.6, 0.4
"""Worth of a word that is a name's head, elsewhere in the name, in category or further words, the end or beginning of a
compound, and of the same line of the thesaurus."""
LEAST_COMPOUND = 3
"""Letters of the shorter part of a compound."""
WORD = re.compile(r"[^\W\d_]+")
BREAK = re.compile(r"\b(?:with|of|in|on|for|and|from|-)\b|[-,:(]")
COMMON = frozenset(
    """
    a an the and or of in on at by to from with without for is are it its this that these those as very one two
    three four some any seen view front back side top above below left right small large big little old new photo
    picture image object thing white black red green blue brown gray yellow orange pink purple beige dark light
    made has have color colored round long short thin thick tall low high standing lying
    """.split()  # noqa: SIM905 (a list of 90 words reads worse)
)
"""Words that say nothing about the kind of a thing, or hold for many kinds."""


def tokens(text: str) -> list[str]:
    """Words of a text in lower case and singular, in any script."""
    plain = unicodedata.normalize("NFKC", text[:MAX_LENGTH]).casefold()
    return [singular(word) for word in WORD.findall(plain)]


def singular(word: str) -> str:
    """English plurals lose their s; other words stay."""
    if len(word) > 4 and word.endswith(("ches", "shes", "xes", "sses")):
        return word[:-2]
    return word[:-1] if len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")) else word


def word_scores(entries: Sequence[Entry], texts: Sequence[str]) -> list[float]:
    """Scores of the entries, the higher the more the texts speak of them; all 0 when no word is known."""
    wanted = Counter(word for text in texts for word in set(tokens(text)) - COMMON)
    if not wanted:
        return [0.0] * len(entries)
    named = [_Words(entry) for entry in entries]
    known = Counter(word for one in named for word in one.all)
    scores = [0.0] * len(entries)
    for word, times in wanted.items():
        worth = [one.match(word) for one in named]
        found = sum(value > 0 for value in worth)
        rarity = math.log1p(len(entries) / (1 + max(found, known[word])))
        scores = [score + times * rarity * value for score, value in zip(scores, worth, strict=True)]
    return scores


class _Words:
    """The words of an entry by their place."""

    def __init__(self, entry: Entry) -> None:
        name = entry.name or re.sub(r"(?<=[a-z])(?=[A-Z])", " ", entry.id)
        first = tokens(BREAK.split(name)[0])
        self.name = tokens(name)
        self.head = (first or self.name or [""])[-1]
        self.told = frozenset(tokens(f"{entry.category} {entry.words}"))
        self.all = frozenset(self.name) | self.told

    def match(self, word: str) -> float:
        """The worth of a word of the expert's for this entry."""
        if word == self.head:
            return HEAD
        if _is_kind(word, self.head):
            return AKIN
        if word in self.name:
            return NAME
        if word in self.told:
            return TOLD
        return KIN if self.head and self.head in kin(word) else 0.0


def _is_kind(word: str, other: str) -> bool:
    """True for a compound and its last part, either way: armchair, chair."""
    short, long = sorted((word, other), key=len)
    return len(short) >= LEAST_COMPOUND and long.endswith(short)


@cache
def _thesaurus() -> dict[str, frozenset[str]]:
    found: dict[str, frozenset[str]] = {}
    for line in THESAURUS.read_text(encoding="utf-8").splitlines():
        words = frozenset() if line.startswith("#") else frozenset(tokens(line))
        for word in words:
            found[word] = found.get(word, frozenset()) | words
    return found


def kin(word: str) -> frozenset[str]:
    """Words of the same lines of the thesaurus."""
    return _thesaurus().get(word, frozenset())
