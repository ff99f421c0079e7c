"""Parses prompts from a model's reply: the first valid JSON, its entries validated one by one, rejected ones reported.

Requested: {"all": [{"text": "...", "why": "..."}], "front": [...], ..., "negative": [...]}. The position in the object
determines view and polarity, never the text. Plain strings as entries, a bare list and a numbered list in prose, which
small models write, are accepted as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

from gsopt._optional import require
from gsopt.llm_prompts.deduplicate import find_duplicate
from gsopt.llm_prompts.expand import PromptSpec
from gsopt.llm_prompts.sanitize import OTHER_VIEW, UnusableText, cleaned, cleaned_rationale
from gsopt.llm_prompts.subject import names_object
from gsopt.llm_prompts.tokens import MAX_TOKENS, TokenCounter
from gsopt.sds.prompts import Prompt, View

MAX_REPLY_CHARACTERS = 200_000
"""Characters of a reply that are parsed."""
MAX_JSON_STARTS = 200
"""Number of possible beginnings of JSON to try."""
MAX_DOCUMENTS = 8
MAX_ENTRIES = 64
"""Limit per list of a reply."""
MAX_PROBLEMS = 12
START = re.compile(r"[{\[]")
LISTED = re.compile(r"^[^\S\n]*(?:[-*\u2022]|\(?\d{1,3}[.):])[^\S\n]+(\S.*)$", re.M)
THOUGHT = re.compile(r"\A.*</think(?:ing)?>", re.S)
WHOLE_LIST = ("prompts", "descriptions", "all")
"""Keys that models use instead of `all`."""


class Entry(Protocol):
    """One validated entry of a reply."""

    text: str
    why: str


@dataclass(frozen=True)
class ParsedReply:
    """Prompts and problems of a reply."""

    prompts: tuple[Prompt, ...]
    problems: tuple[str, ...]
    """Rejected entries with reasons, without text of the model: safe to send and display."""


def reply_schema(slots: Mapping[str, int]) -> dict[str, Any]:
    """Returns the JSON Schema of the reply, in the strict subset that servers enforce (exactly the listed keys)."""
    entry = {
        "type": "object",
        "properties": {"text": {"type": "string"}, "why": {"type": "string"}},
        "required": ["text", "why"],
        "additionalProperties": False,
    }
    lists = {slot: {"type": "array", "items": entry} for slot, count in slots.items() if count}
    return {"type": "object", "properties": lists, "required": list(lists), "additionalProperties": False}


def read_reply(
    answer: str, spec: PromptSpec, source: str, counter: TokenCounter, kept: tuple[Prompt, ...]
) -> ParsedReply:
    """Returns prompts that differ from those `kept`, from the first JSON of the reply that has any.

    Never raises, whatever the reply.
    """
    reads = [_read(document, spec, source, counter, kept) for document in _documents(answer, spec.slots)]
    if not reads:
        return ParsedReply((), ("the answer holds no JSON object" if answer.strip() else "the answer was empty",))
    return next((read for read in reads if read.prompts), reads[0])


def _read(
    document: dict[str, Any], spec: PromptSpec, source: str, counter: TokenCounter, kept: tuple[Prompt, ...]
) -> ParsedReply:
    prompts: list[Prompt] = []
    problems: list[str] = []
    for slot, entry in _entries(document, spec.slots, problems):
        try:
            prompt = _prompt(slot, entry, spec, source, counter)
            duplicate = find_duplicate(prompt, [*kept, *prompts])
            if duplicate is not None:
                raise UnusableText(f'it repeats "{duplicate.text[:60]}"')
            prompts.append(prompt)
        except UnusableText as reason:
            problems.append(f"one entry of `{slot}` was refused: {reason}")
    if not prompts and not problems:
        problems.append("the lists are empty")
    return ParsedReply(tuple(prompts), tuple(dict.fromkeys(problems))[:MAX_PROBLEMS])


def _documents(answer: str, slots: Mapping[str, int]) -> list[dict[str, Any]]:
    """Returns JSON values in the format of a reply, else all objects, else a list in prose."""
    text = THOUGHT.sub("", answer[:MAX_REPLY_CHARACTERS])
    objects = [value if isinstance(value, dict) else {"all": value} for value in _json_values(text)][:MAX_DOCUMENTS]
    likely = [d for d in objects if any(isinstance(d.get(key), (list, str, dict)) for key in (*slots, *WHOLE_LIST))]
    listed = LISTED.findall(text)
    return likely or objects or ([{"all": listed}] if listed else [])


def _json_values(text: str) -> Iterator[Any]:
    """Yields the outermost nonempty objects and lists of texts or objects, from left to right."""
    decoder = json.JSONDecoder()
    place = 0
    for _ in range(MAX_JSON_STARTS):
        start = START.search(text, place)
        if start is None:
            return
        try:
            value, place = decoder.raw_decode(text, start.start())
        except (ValueError, RecursionError):
            place = start.start() + 1
            continue
        if value and (isinstance(value, dict) or all(isinstance(entry, (str, dict)) for entry in value)):
            yield value


def _entries(document: dict[str, Any], slots: Mapping[str, int], problems: list[str]) -> Iterator[tuple[str, Entry]]:
    """Yields (slot, entry) of every requested list."""
    found = False
    for slot, count in slots.items():
        rows = document.get(slot)
        if rows is None and slot == "all":
            rows = next((document[key] for key in WHOLE_LIST if key in document), None)
        if rows is None or not count:
            continue
        found = True
        for row in (rows if isinstance(rows, list) else [rows])[:MAX_ENTRIES]:
            entry = validated(row)
            if isinstance(entry, str):
                problems.append(f"one entry of `{slot}` was refused: {entry}")
            else:
                yield slot, entry
    if not found:
        problems.append(f"the JSON object has none of the lists {', '.join(slots)}")


def validated(row: Any) -> Entry | str:
    """Returns an entry of the schema, or its error."""
    pydantic = require("pydantic", "llm", "Checking a language model's reply")
    from gsopt.llm_prompts.reply_model import EntryModel

    values = {"text": row} if isinstance(row, str) else row
    try:
        return cast(Entry, EntryModel.model_validate(values))
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        return f"`{'.'.join(map(str, first['loc'])) or 'entry'}`: {first['msg']}"


def _prompt(slot: str, entry: Entry, spec: PromptSpec, source: str, counter: TokenCounter) -> Prompt:
    """Raises UnusableText."""
    negative = slot == "negative"
    text = cleaned(entry.text, min_words=1 if negative else 3)
    if not negative and not names_object(text, spec.object):
        raise UnusableText(f'it does not name the object "{spec.object}"')
    if OTHER_VIEW.search(text):
        raise UnusableText("it names a camera view, which is added later")
    if counter.count(text) > MAX_TOKENS:
        raise UnusableText(f"it has {counter.count(text)} CLIP tokens, more than {MAX_TOKENS}")
    why = cleaned_rationale(entry.why)
    if negative:
        return Prompt(text, polarity="negative", source=source, rationale=why)
    return Prompt(text, view=cast(View, slot), source=source, rationale=why)
