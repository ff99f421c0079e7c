"""Finds the noun of an object in an expert's notes by rules of thumb, and checks that a text contains it."""

from __future__ import annotations

import re

from gsopt.errors import UsageError
from gsopt.sds.prompts import MAX_NAME_LENGTH

WORD = re.compile(r"[^\W_]+(?:[-'][^\W_]+)*")
_AFTER = """with without of from in on at for by made having standing lying that which who whose and or near under above
below behind beside before after used seen shown found"""
_LITTLE = """a an the this that these those its his her their my our your of with in on at for by from to and or as is
are was were it be been has have one some any very"""
AFTER_THE_NOUN = frozenset(_AFTER.split())
"""The noun of a phrase stands before the first of these: "a chair with one broken arm", "a stone from a river"."""
STOP_WORDS = frozenset(_LITTLE.split())
"""Words without content."""


def find_object(notes: str) -> str:
    """Returns the noun: the last word of the first phrase, before any preposition. "worn oak chair, one arm broken" ->
    chair.

    Raises UsageError if no word is left; `--category` gives the noun then.
    """
    first = re.split(r"[,.;:!?()\n]", notes.strip(), maxsplit=1)[0]
    words = [word.lower() for word in WORD.findall(first)]
    phrase: list[str] = []
    for word in words:
        if word in AFTER_THE_NOUN and phrase:
            break
        if word not in STOP_WORDS and not word.isdigit():
            phrase.append(word)
    if not phrase:
        raise UsageError(
            f"No object was found in the notes, got {notes[:60]!r}. Begin them with the object, or name it with "
            "--category."
        )
    return phrase[-1][:MAX_NAME_LENGTH]


def names_object(text: str, noun: str) -> bool:
    """True if the text contains the noun, singular or plural."""
    said = {stem(word) for word in WORD.findall(text.lower())}
    return {stem(word) for word in WORD.findall(noun.lower()) if word not in STOP_WORDS} <= said


def stem(word: str) -> str:
    """Without the plural's ending. Rough, but the same for both numbers of a regular noun."""
    for ending, singular in (("ies", "y"), ("ses", "s"), ("xes", "x"), ("ches", "ch"), ("shes", "sh")):
        if word.endswith(ending) and len(word) > len(ending) + 1:
            return word[: -len(ending)] + singular
    return word[:-1] if word.endswith("s") and not word.endswith(("ss", "us", "is")) and len(word) > 3 else word


def with_article(noun: str) -> str:
    """Returns a chair, an urn; leaves plurals unchanged."""
    if noun.split()[0].lower() in STOP_WORDS:
        return noun
    last = noun.lower().split()[-1]
    if stem(last) != last:
        return noun
    return f"{'an' if noun[0].lower() in 'aeiou' else 'a'} {noun}"


def content_words(text: str) -> frozenset[str]:
    """Returns the content words, without number and order."""
    return frozenset(stem(word) for word in WORD.findall(text.lower()) if word not in STOP_WORDS)
