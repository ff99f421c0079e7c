"""Removes prompts with the same content words as another one."""

from __future__ import annotations

from collections.abc import Iterable

from gsopt.llm_prompts.subject import content_words
from gsopt.sds.prompts import Prompt

MIN_SIMILARITY = 0.8
"""Jaccard similarity of content words from which two texts count as duplicates."""


def is_similar(text: str, other: str) -> bool:
    """True if two texts have (almost) the same content words, regardless of order and number."""
    a, b = content_words(text), content_words(other)
    return len(a & b) >= MIN_SIMILARITY * len(a | b)


def find_duplicate(prompt: Prompt, others: Iterable[Prompt]) -> Prompt | None:
    """Returns the first similar prompt with the same polarity and an overlapping view."""
    for other in others:
        seen_together = "all" in (prompt.view, other.view) or prompt.view == other.view
        if prompt.polarity == other.polarity and seen_together and is_similar(prompt.text, other.text):
            return other
    return None


def without_duplicates(prompts: Iterable[Prompt]) -> tuple[Prompt, ...]:
    """Returns the prompts in order without duplicates of earlier ones."""
    kept: list[Prompt] = []
    for prompt in prompts:
        if find_duplicate(prompt, kept) is None:
            kept.append(prompt)
    return tuple(kept)
