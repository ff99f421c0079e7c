"""The expert looks at every prompt and picture: accept, edit, reject. Questions and answers are lines of text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import get_args

from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.llm_prompts.sanitize import printable
from gsopt.llm_prompts.schema import LONGEST_TEXT, Picture, Prompt, PromptSet, View

HELP = (
    "  Enter or a: accept   e: edit the text   w: weight   v: view   r: reject   "
    "b: back   all: accept the rest   q: quit, nothing is changed"
)
HELP_PICTURE = "  a: accept   Enter or r: reject   q: quit, nothing is changed"

Ask = Callable[[str], str]


class Abandoned(Exception):
    """The expert left before the end."""


@dataclass(frozen=True)
class Shown:
    """A prompt in review; `accepted` None: not decided yet."""

    prompt: Prompt
    accepted: bool | None = None


def review(everything: PromptSet, ask: Ask, report: Report) -> PromptSet:
    """What is left after the review, marked as reviewed. Raises Abandoned when the expert quits or the input ends."""
    try:
        prompts = _prompts(everything.prompts, ask, report)
        images = tuple(_picture(picture, ask, report) for picture in everything.images)
    except EOFError as end:
        raise Abandoned from end
    return replace(everything, prompts=prompts, images=images, reviewed=True)


def line(number: int, count: int, prompt: Prompt) -> str:
    """A prompt in one line of a list."""
    sign = "-" if prompt.polarity == "negative" else "+"
    weight = "" if prompt.weight == 1 else f" x{prompt.weight:g}"
    score = "" if prompt.score is None else f" CLIP {prompt.score:.3f}"
    text = printable(prompt.text, LONGEST_TEXT)
    return f"{number:>3}/{count} {sign} {prompt.view:<5} {prompt.source:<8}{weight}{score}  {text}"


def _prompts(prompts: tuple[Prompt, ...], ask: Ask, report: Report) -> tuple[Prompt, ...]:
    shown = [Shown(prompt) for prompt in prompts]
    report(HELP)
    number = 0
    while number < len(shown):
        report(line(number + 1, len(shown), shown[number].prompt))
        if shown[number].prompt.rationale:
            report(f"        why: {printable(shown[number].prompt.rationale, LONGEST_TEXT)}")
        answer = ask("? ").strip()
        if answer == "all":
            shown[number:] = [Shown(each.prompt, True) for each in shown[number:]]
            break
        if answer == "b":
            number = max(0, number - 1)
            continue
        shown[number] = _decided(shown[number], answer, ask, report)
        number += shown[number].accepted is not None
    return tuple(each.prompt for each in shown if each.accepted)


def _decided(shown: Shown, answer: str, ask: Ask, report: Report) -> Shown:
    """After one answer; still undecided where it changed something or was not understood."""
    try:
        match answer:
            case "" | "a":
                return replace(shown, accepted=True)
            case "r":
                return replace(shown, accepted=False)
            case "q":
                raise Abandoned
            case "e":
                return Shown(edited(shown.prompt, ask("text: ")))
            case "w":
                return Shown(replace(shown.prompt, weight=_number(ask("weight: "))))
            case "v":
                return Shown(replace(shown.prompt, view=_view(ask(f"view ({', '.join(get_args(View))}): "))))
    except InputError as error:
        report(f"  {error}")
        return replace(shown, accepted=None)
    report(HELP)
    return replace(shown, accepted=None)


def edited(prompt: Prompt, text: str) -> Prompt:
    """With the expert's text: it is the expert's from then on, its origin stands in the rationale."""
    text = " ".join(text.split())
    if not text or text == prompt.text:
        return prompt
    origin = prompt.rationale if prompt.source == "user" else f"edited; {prompt.source} wrote: {prompt.text}"
    return replace(prompt, text=text, source="user", rationale=origin, score=None)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"A weight is a number, got {text[:40]!r}. 1 is usual, 0 keeps the prompt out.") from error


def _view(text: str) -> View:
    return Prompt("x", view=text.strip()).view  # type: ignore[arg-type]


def _picture(picture: Picture, ask: Ask, report: Report) -> Picture:
    while True:
        origin = printable(f"by {picture.source or 'unknown'}, from: {picture.prompt}", LONGEST_TEXT)
        report(f"    picture {picture.file}, {origin}")
        answer = ask("accept this picture? ").strip()
        if answer == "q":
            raise Abandoned
        if answer in ("a", "y", "yes"):
            return replace(picture, accepted=True)
        if answer in ("", "r", "n", "no"):
            return replace(picture, accepted=False)
        report(HELP_PICTURE)
