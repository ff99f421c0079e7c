"""Makes prompts without a language model, from a template's phrases and its descriptions of words in the notes.

Deterministic: same notes, same template, same prompts. Their source is `template`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, zip_longest

from gsopt.llm_prompts.deduplicate import find_duplicate, without_duplicates
from gsopt.llm_prompts.subject import WORD, content_words, stem, with_article
from gsopt.llm_prompts.templates import Template, fill
from gsopt.llm_prompts.tokens import MAX_TOKENS, TokenCounter
from gsopt.sds.prompts import MAX_TEXT_LENGTH, Prompt, View

SIDES: tuple[View, ...] = ("front", "side", "back", "top")
NEGATED = re.compile(r"\b(?:without|no|not|lacks|lacking|missing)\b[^,.;:\n]*", re.IGNORECASE)
"""Negations in the notes: "chair without armrests"."""
MIN_PROMPTS_WITH_SIDES = 6
"""Number of prompts from which on each side has one of its own."""


@dataclass(frozen=True)
class PromptSpec:
    """The object to describe and the numbers of prompts."""

    notes: str
    object: str
    n: int
    """Number of positive prompts beside the expert's own."""
    negatives: int

    @property
    def slots(self) -> dict[str, int]:
        """Number of prompts per view, and of negative ones."""
        sides: dict[str, int] = dict.fromkeys(SIDES, 1) if self.n >= MIN_PROMPTS_WITH_SIDES else {}
        return {"all": self.n - len(sides), **sides, "negative": self.negatives}


def expert_prompt(spec: PromptSpec) -> Prompt:
    """Returns the notes as one prompt on one line."""
    return Prompt(" ".join(spec.notes.split())[:MAX_TEXT_LENGTH], source="user", rationale="the expert's own words")


def expand(template: Template, spec: PromptSpec, counter: TokenCounter) -> tuple[Prompt, ...]:
    """Returns the requested number of prompts, or fewer if the template has no more; without the expert's own
    prompt."""
    makers: dict[str, Callable[[], Iterator[Prompt]]] = {
        "all": lambda: _whole(template, spec, counter),
        "negative": lambda: _negatives(template, spec),
        **{side: (lambda side=side: _one_side(template, spec, side, counter)) for side in SIDES},  # type: ignore[misc]
    }
    made: list[Prompt] = []
    for slot, count in spec.slots.items():
        made += _first(count, makers[slot](), made)
    return tuple(made)


def _first(count: int, candidates: Iterator[Prompt], others: list[Prompt]) -> list[Prompt]:
    """Returns the first `count` prompts that are no duplicates."""
    kept: list[Prompt] = []
    for prompt in candidates:
        if len(kept) == count:
            break
        if find_duplicate(prompt, [*others, *kept]) is None:
            kept.append(prompt)
    return kept


def _whole(template: Template, spec: PromptSpec, counter: TokenCounter) -> Iterator[Prompt]:
    """Alternates descriptions of the notes' words with general phrases."""
    known = _known(template, spec, "all")
    phrases = _phrases(template, "phrases", spec, "all", counter)
    return (prompt for prompt in chain.from_iterable(zip_longest(known, phrases)) if prompt is not None)


def _one_side(template: Template, spec: PromptSpec, side: View, counter: TokenCounter) -> Iterator[Prompt]:
    return chain(_known(template, spec, side), _phrases(template, side, spec, side, counter))


def _known(template: Template, spec: PromptSpec, view: View) -> Iterator[Prompt]:
    """Yields `a femur, thinned cortex ...`: one prompt per described word of the notes, the noun's first."""
    noun, described = content_words(spec.object), content_words(NEGATED.sub("", spec.notes))
    denied = content_words(" ".join(NEGATED.findall(spec.notes))) - noun
    entries = [word for word in template.words if word.view == view and not content_words(word.description) & denied]
    for wanted in (noun, described - noun):
        for entry in entries:
            word = next((word for word in entry.words if {stem(w) for w in WORD.findall(word)} <= wanted), None)
            if word is not None:
                text = f"{with_article(spec.object)}, {entry.description}"
                yield Prompt(text, view=view, source="template", rationale=f"{template.name}: what `{word}` looks like")


def _phrases(template: Template, section: str, spec: PromptSpec, view: View, counter: TokenCounter) -> Iterator[Prompt]:
    for number, phrase in enumerate(template.lists[section], 1):
        text = fill_phrase(phrase, spec, counter)
        yield Prompt(text, view=view, source="template", rationale=f"{template.name}: {section} {number}")


def _negatives(template: Template, spec: PromptSpec) -> Iterator[Prompt]:
    """Yields negative prompts without the terms of the notes."""
    said = content_words(spec.notes)
    for number, entry in enumerate(template.lists["negative"], 1):
        terms = [term for term in entry.split(", ") if not content_words(term) & said]
        if terms:
            rationale = f"{template.name}: negative {number}"
            yield Prompt(", ".join(terms), polarity="negative", source="template", rationale=rationale)


def fill_phrase(phrase: str, spec: PromptSpec, counter: TokenCounter) -> str:
    """Fills the phrase with as many clauses of the notes as CLIP reads."""
    notes = " ".join(spec.notes.split()).rstrip(".;, ")
    if "{a_object}" in phrase and content_words(notes) == content_words(spec.object):
        phrase = phrase.removesuffix(": {notes}")  # the notes hold the noun only
    clauses = re.split(r"(?<=[,;.])\s+", notes)
    values = {"object": spec.object, "a_object": with_article(spec.object)}
    for count in range(len(clauses), 0, -1):
        text = fill(phrase, {**values, "notes": " ".join(clauses[:count]).rstrip(",;. ")})
        if counter.count(text) <= MAX_TOKENS:
            return text
    return fill(phrase, {**values, "notes": with_article(spec.object)})


def fill_with_template(
    made: tuple[Prompt, ...], template: Template, spec: PromptSpec, counter: TokenCounter
) -> tuple[Prompt, ...]:
    """Adds template prompts for every kind that a model's prompts lack."""
    more: list[Prompt] = []
    for slot, count in spec.slots.items():
        missing = count - sum(slot_of(prompt) == slot for prompt in made)
        # More than missing: some may be duplicates of the model's.
        spare = replace(spec, n=spec.n + len(made), negatives=spec.negatives + len(made))
        candidates = (prompt for prompt in expand(template, spare, counter) if slot_of(prompt) == slot)
        more += _first(max(0, missing), candidates, [*made, *more])
    return without_duplicates((*made, *more))


def slot_of(prompt: Prompt) -> str:
    """Returns the view, or `negative`."""
    return "negative" if prompt.polarity == "negative" else prompt.view
