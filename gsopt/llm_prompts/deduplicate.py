"""No two prompts that say the same: compared by the words that matter."""

from __future__ import annotations

from collections.abc import Iterable

from gsopt.llm_prompts.schema import Prompt
from gsopt.llm_prompts.subject import content

ALIKE = 0.8
"""Share of common words (Jaccard) from which two texts count as one."""


def is_like(text: str, other: str) -> bool:
    """Whether two texts have (almost) the same words, in whatever order and number."""
    a, b = content(text), content(other)
    return len(a & b) >= ALIKE * len(a | b)


def repeated(prompt: Prompt, others: Iterable[Prompt]) -> Prompt | None:
    """The first of the others that says the same with the same polarity and an overlapping view."""
    for other in others:
        seen_together = "all" in (prompt.view, other.view) or prompt.view == other.view
        if prompt.polarity == other.polarity and seen_together and is_like(prompt.text, other.text):
            return other
    return None


def without_repetitions(prompts: Iterable[Prompt]) -> tuple[Prompt, ...]:
    """The prompts in order, each only if none before it says the same."""
    kept: list[Prompt] = []
    for prompt in prompts:
        if repeated(prompt, kept) is None:
            kept.append(prompt)
    return tuple(kept)
