"""Prompts without a language model: a template's phrases and what it knows about the words of the notes.

Deterministic: same notes, same template, same prompts. Every one says `template` as its source.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, zip_longest

from gsopt.llm_prompts.deduplicate import repeated, without_repetitions
from gsopt.llm_prompts.schema import LONGEST_TEXT, Prompt, View
from gsopt.llm_prompts.subject import WORD, content, stem, with_article
from gsopt.llm_prompts.templates import Template, fill
from gsopt.llm_prompts.tokens import LONGEST, Counter

SIDES: tuple[View, ...] = ("front", "side", "back", "top")
DENIED = re.compile(r"\b(?:without|no|not|lacks|lacking|missing)\b[^,.;:\n]*", re.IGNORECASE)
"""What the notes say is not there: "chair without armrests"."""
FEWEST_WITH_SIDES = 6
"""Prompts from which on each side gets one of its own."""


@dataclass(frozen=True)
class Wish:
    """What is to be described, and how often."""

    notes: str
    object: str
    n: int
    """Positive prompts, the expert's own not counted."""
    negatives: int

    @property
    def slots(self) -> dict[str, int]:
        """How many prompts per view, and negative ones."""
        sides: dict[str, int] = dict.fromkeys(SIDES, 1) if self.n >= FEWEST_WITH_SIDES else {}
        return {"all": self.n - len(sides), **sides, "negative": self.negatives}


def own_words(wish: Wish) -> Prompt:
    """The notes as they are, on one line."""
    return Prompt(" ".join(wish.notes.split())[:LONGEST_TEXT], source="user", rationale="the expert's own words")


def expand(template: Template, wish: Wish, counter: Counter) -> tuple[Prompt, ...]:
    """As many prompts as wished, fewer where the template has no more to say. The expert's own words are not in it."""
    makers: dict[str, Callable[[], Iterator[Prompt]]] = {
        "all": lambda: _whole(template, wish, counter),
        "negative": lambda: _negatives(template, wish),
        **{side: (lambda side=side: _one_side(template, wish, side, counter)) for side in SIDES},  # type: ignore[misc]
    }
    made: list[Prompt] = []
    for slot, count in wish.slots.items():
        made += _first(count, makers[slot](), made)
    return tuple(made)


def _first(count: int, candidates: Iterator[Prompt], others: list[Prompt]) -> list[Prompt]:
    """The first `count` that repeat nothing."""
    kept: list[Prompt] = []
    for prompt in candidates:
        if len(kept) == count:
            break
        if repeated(prompt, [*others, *kept]) is None:
            kept.append(prompt)
    return kept


def _whole(template: Template, wish: Wish, counter: Counter) -> Iterator[Prompt]:
    """What is known about the notes' words and general phrases in turn; what is known first."""
    known = _known(template, wish, "all")
    phrases = _phrases(template, "phrases", wish, "all", counter)
    return (prompt for prompt in chain.from_iterable(zip_longest(known, phrases)) if prompt is not None)


def _one_side(template: Template, wish: Wish, side: View, counter: Counter) -> Iterator[Prompt]:
    return chain(_known(template, wish, side), _phrases(template, side, wish, side, counter))


def _known(template: Template, wish: Wish, view: View) -> Iterator[Prompt]:
    """`a femur, thinned cortex ...`: one prompt per word of the notes that the template knows; the noun's first."""
    noun, said = content(wish.object), content(DENIED.sub("", wish.notes))
    denied = content(" ".join(DENIED.findall(wish.notes))) - noun
    entries = [word for word in template.words if word.view == view and not content(word.description) & denied]
    for wanted in (noun, said - noun):
        for entry in entries:
            word = next((word for word in entry.words if {stem(w) for w in WORD.findall(word)} <= wanted), None)
            if word is not None:
                text = f"{with_article(wish.object)}, {entry.description}"
                yield Prompt(text, view=view, source="template", rationale=f"{template.name}: what `{word}` looks like")


def _phrases(template: Template, section: str, wish: Wish, view: View, counter: Counter) -> Iterator[Prompt]:
    for number, phrase in enumerate(template.lists[section], 1):
        text = fitted(phrase, wish, counter)
        yield Prompt(text, view=view, source="template", rationale=f"{template.name}: {section} {number}")


def _negatives(template: Template, wish: Wish) -> Iterator[Prompt]:
    """What the object is not, less what the notes say it is."""
    said = content(wish.notes)
    for number, entry in enumerate(template.lists["negative"], 1):
        terms = [term for term in entry.split(", ") if not content(term) & said]
        if terms:
            rationale = f"{template.name}: negative {number}"
            yield Prompt(", ".join(terms), polarity="negative", source="template", rationale=rationale)


def fitted(phrase: str, wish: Wish, counter: Counter) -> str:
    """The phrase with the notes in it; as many of their clauses as CLIP reads."""
    notes = " ".join(wish.notes.split()).rstrip(".;, ")
    if "{a_object}" in phrase and content(notes) == content(wish.object):
        phrase = phrase.removesuffix(": {notes}")  # they say no more than the noun does
    clauses = re.split(r"(?<=[,;.])\s+", notes)
    values = {"object": wish.object, "a_object": with_article(wish.object)}
    for count in range(len(clauses), 0, -1):
        text = fill(phrase, {**values, "notes": " ".join(clauses[:count]).rstrip(",;. ")})
        if counter.count(text) <= LONGEST:
            return text
    return fill(phrase, {**values, "notes": with_article(wish.object)})


def filled_up(made: tuple[Prompt, ...], template: Template, wish: Wish, counter: Counter) -> tuple[Prompt, ...]:
    """Prompts of a model, and template ones for what is missing of each kind."""
    more: list[Prompt] = []
    for slot, count in wish.slots.items():
        missing = count - sum(slot_of(prompt) == slot for prompt in made)
        # Asked for more than is missing: some may repeat what the model said.
        spare = replace(wish, n=wish.n + len(made), negatives=wish.negatives + len(made))
        candidates = (prompt for prompt in expand(template, spare, counter) if slot_of(prompt) == slot)
        more += _first(max(0, missing), candidates, [*made, *more])
    return without_repetitions((*made, *more))


def slot_of(prompt: Prompt) -> str:
    """The view, or `negative`."""
    return "negative" if prompt.polarity == "negative" else prompt.view
