"""Interactive review of every prompt and image: accept, edit or reject, by lines of text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.llm_prompts.sanitize import printable
from gsopt.sds.prompts import MAX_TEXT_LENGTH, Prompt, PromptSet, ReferenceImage, View

HELP = (
    "  Enter or a: accept   e: edit the text   w: weight   v: view   r: reject   "
    "b: back   all: accept the rest   q: quit, nothing is changed"
)
HELP_PICTURE = "  a: accept   Enter or r: reject   q: quit, nothing is changed"

Ask = Callable[[str], str]


class ReviewAborted(Exception):
    """The expert quit before the end."""


@dataclass(frozen=True)
class ReviewItem:
    """A prompt in review; `accepted` is `None` until decided."""

    prompt: Prompt
    accepted: bool | None = None


def review(prompt_set: PromptSet, ask: Ask, report: Report) -> PromptSet:
    """Returns the accepted prompts and images, marked as reviewed. Raises ReviewAborted if the expert quits or input
    ends."""
    try:
        prompts = _prompts(prompt_set.prompts, ask, report)
        images = tuple(_picture(picture, ask, report) for picture in prompt_set.images)
    except EOFError as end:
        raise ReviewAborted from end
    return replace(prompt_set, prompts=prompts, images=images, reviewed=True)


def line(number: int, count: int, prompt: Prompt) -> str:
    """Returns a prompt as one line of a list."""
    sign = "-" if prompt.polarity == "negative" else "+"
    weight = "" if prompt.weight == 1 else f" x{prompt.weight:g}"
    score = "" if prompt.score is None else f" CLIP {prompt.score:.3f}"
    text = printable(prompt.text, MAX_TEXT_LENGTH)
    return f"{number:>3}/{count} {sign} {prompt.view:<5} {prompt.source:<8}{weight}{score}  {text}"


def _prompts(prompts: tuple[Prompt, ...], ask: Ask, report: Report) -> tuple[Prompt, ...]:
    items = [ReviewItem(prompt) for prompt in prompts]
    report(HELP)
    number = 0
    while number < len(items):
        report(line(number + 1, len(items), items[number].prompt))
        if items[number].prompt.rationale:
            report(f"        why: {printable(items[number].prompt.rationale, MAX_TEXT_LENGTH)}")
        answer = ask("? ").strip()
        if answer == "all":
            items[number:] = [ReviewItem(each.prompt, True) for each in items[number:]]
            break
        if answer == "b":
            number = max(0, number - 1)
            continue
        items[number] = _decided(items[number], answer, ask, report)
        number += items[number].accepted is not None
    return tuple(each.prompt for each in items if each.accepted)


def _decided(item: ReviewItem, answer: str, ask: Ask, report: Report) -> ReviewItem:
    """Applies one answer; the item stays undecided after a change or an unknown answer."""
    try:
        match answer:
            case "" | "a":
                return replace(item, accepted=True)
            case "r":
                return replace(item, accepted=False)
            case "q":
                raise ReviewAborted
            case "e":
                return ReviewItem(edited(item.prompt, ask("text: ")))
            case "w":
                return ReviewItem(replace(item.prompt, weight=_number(ask("weight: "))))
            case "v":
                return ReviewItem(replace(item.prompt, view=_view(ask(f"view ({', '.join(get_args(View))}): "))))
    except InputError as error:
        report(f"  {error}")
        return replace(item, accepted=None)
    report(HELP)
    return replace(item, accepted=None)


def edited(prompt: Prompt, text: str) -> Prompt:
    """Returns the prompt with the expert's text and `user` as source; the rationale keeps its origin."""
    text = " ".join(text.split())
    if not text or text == prompt.text:
        return prompt
    origin = prompt.rationale if prompt.source == "user" else f"edited; {prompt.source} wrote: {prompt.text}"
    return replace(prompt, text=text, source="user", rationale=origin, score=None)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"A weight is a number, got {text[:40]!r}. 1 is usual, 0 disables the prompt.") from error


def _view(text: str) -> View:
    return Prompt("x", view=text.strip()).view  # type: ignore[arg-type]


def _picture(picture: ReferenceImage, ask: Ask, report: Report) -> ReferenceImage:
    while True:
        origin = printable(f"by {picture.source or 'unknown'}, from: {picture.prompt}", MAX_TEXT_LENGTH)
        report(f"    picture {picture.file}, {origin}")
        answer = ask("accept this picture? ").strip()
        if answer == "q":
            raise ReviewAborted
        if answer in ("a", "y", "yes"):
            return replace(picture, accepted=True)
        if answer in ("", "r", "n", "no"):
            return replace(picture, accepted=False)
        report(HELP_PICTURE)
