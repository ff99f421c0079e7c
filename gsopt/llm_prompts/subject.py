"""The noun of an object, as far as rules of thumb find it in an expert's notes, and whether a text keeps it."""

from __future__ import annotations

import re

from gsopt.errors import UsageError
from gsopt.llm_prompts.schema import LONGEST_NAME

WORD = re.compile(r"[^\W_]+(?:[-'][^\W_]+)*")
_AFTER = """with without of from in on at for by made having standing lying that which who whose and or near under above
below behind beside before after used seen shown found"""
_LITTLE = """a an the this that these those its his her their my our your of with in on at for by from to and or as is
are was were it be been has have one some any very"""
AFTER_THE_NOUN = frozenset(_AFTER.split())
"""The noun of a phrase stands before the first of these: "a chair with one broken arm", "a stone from a river"."""
LITTLE = frozenset(_LITTLE.split())
"""Words that say nothing about what a text is about."""


def find_object(notes: str) -> str:
    """The noun: the last word of the first phrase, before any preposition. "worn oak chair, one arm broken" -> chair.

    Raises UsageError where no word is left; `--category` says it then.
    """
    first = re.split(r"[,.;:!?()\n]", notes.strip(), maxsplit=1)[0]
    words = [word.lower() for word in WORD.findall(first)]
    phrase: list[str] = []
    for word in words:
        if word in AFTER_THE_NOUN and phrase:
            break
        if word not in LITTLE and not word.isdigit():
            phrase.append(word)
    if not phrase:
        raise UsageError(
            f"No object was found in the notes, got {notes[:60]!r}. Begin them with the object, or name it with "
            "--category."
        )
    return phrase[-1][:LONGEST_NAME]


def names(text: str, noun: str) -> bool:
    """Whether the text keeps the noun, singular or plural."""
    said = {stem(word) for word in WORD.findall(text.lower())}
    return {stem(word) for word in WORD.findall(noun.lower()) if word not in LITTLE} <= said


def stem(word: str) -> str:
    """Without the plural's ending. Rough, but the same for both numbers of a regular noun."""
    for ending, singular in (("ies", "y"), ("ses", "s"), ("xes", "x"), ("ches", "ch"), ("shes", "sh")):
        if word.endswith(ending) and len(word) > len(ending) + 1:
            return word[: -len(ending)] + singular
    return word[:-1] if word.endswith("s") and not word.endswith(("ss", "us", "is")) and len(word) > 3 else word


def with_article(noun: str) -> str:
    """a chair, an urn; a plural stays as it is."""
    if noun.split()[0].lower() in LITTLE:
        return noun
    last = noun.lower().split()[-1]
    if stem(last) != last:
        return noun
    return f"{'an' if noun[0].lower() in 'aeiou' else 'a'} {noun}"


def content(text: str) -> frozenset[str]:
    """The words that matter, without number and order."""
    return frozenset(stem(word) for word in WORD.findall(text.lower()) if word not in LITTLE)
