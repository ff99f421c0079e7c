"""From a model's answer to prompts: the first JSON that is a reply, its entries validated one by one, the rest named.

Asked for: {"all": [{"text": "...", "why": "..."}], "front": [...], ..., "negative": [...]}. The place in the object
decides view and polarity; the model's words never do. Plain strings for entries, a bare list and a numbered list in
prose are taken as well: small models answer so.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, cast

from gsopt._optional import require
from gsopt.llm_prompts.deduplicate import repeated
from gsopt.llm_prompts.expand import Wish
from gsopt.llm_prompts.sanitize import OTHER_VIEW, Unusable, cleaned, cleaned_rationale
from gsopt.llm_prompts.schema import Prompt, View
from gsopt.llm_prompts.subject import names
from gsopt.llm_prompts.tokens import LONGEST, Counter

LONGEST_ANSWER = 200_000
"""Characters of an answer that are looked at."""
MOST_STARTS = 200
"""Places where JSON may begin that are tried."""
MOST_DOCUMENTS = 8
MOST_ENTRIES = 64
"""Per list of a reply."""
MOST_PROBLEMS = 12
START = re.compile(r"[{\[]")
LISTED = re.compile(r"^[^\S\n]*(?:[-*\u2022]|\(?\d{1,3}[.):])[^\S\n]+(\S.*)$", re.M)
THOUGHT = re.compile(r"\A.*</think(?:ing)?>", re.S)
WHOLE_LIST = ("prompts", "descriptions", "all")
"""Keys under which models put what belongs under `all`."""


class Entry(Protocol):
    """One entry of a reply, validated."""

    text: str
    why: str


@dataclass(frozen=True)
class Read:
    """What an answer was good for."""

    prompts: tuple[Prompt, ...]
    problems: tuple[str, ...]
    """What was refused and why, in our own words: fit to be sent back and shown."""


def reply_schema(slots: Mapping[str, int]) -> dict[str, Any]:
    """JSON Schema of the reply, in the strict subset that servers enforce (every key required, no other allowed)."""
    entry = {
        "type": "object",
        "properties": {"text": {"type": "string"}, "why": {"type": "string"}},
        "required": ["text", "why"],
        "additionalProperties": False,
    }
    lists = {slot: {"type": "array", "items": entry} for slot, count in slots.items() if count}
    return {"type": "object", "properties": lists, "required": list(lists), "additionalProperties": False}


def read_reply(answer: str, wish: Wish, source: str, counter: Counter, kept: tuple[Prompt, ...]) -> Read:
    """Prompts that say something new beside those `kept`, from the first JSON of the answer that has any.

    Whatever the answer is: this only returns.
    """
    reads = [_read(document, wish, source, counter, kept) for document in _documents(answer, wish.slots)]
    if not reads:
        return Read((), ("the answer holds no JSON object" if answer.strip() else "the answer was empty",))
    return next((read for read in reads if read.prompts), reads[0])


def _read(document: dict[str, Any], wish: Wish, source: str, counter: Counter, kept: tuple[Prompt, ...]) -> Read:
    prompts: list[Prompt] = []
    problems: list[str] = []
    for slot, entry in _entries(document, wish.slots, problems):
        try:
            prompt = _prompt(slot, entry, wish, source, counter)
            twin = repeated(prompt, [*kept, *prompts])
            if twin is not None:
                raise Unusable(f'it repeats "{twin.text[:60]}"')
            prompts.append(prompt)
        except Unusable as reason:
            problems.append(f"one entry of `{slot}` was refused: {reason}")
    if not prompts and not problems:
        problems.append("the lists are empty")
    return Read(tuple(prompts), tuple(dict.fromkeys(problems))[:MOST_PROBLEMS])


def _documents(answer: str, slots: Mapping[str, int]) -> list[dict[str, Any]]:
    """JSON values that look like a reply, else all objects, else a list in prose."""
    text = THOUGHT.sub("", answer[:LONGEST_ANSWER])
    objects = [value if isinstance(value, dict) else {"all": value} for value in _json_values(text)][:MOST_DOCUMENTS]
    likely = [d for d in objects if any(isinstance(d.get(key), (list, str, dict)) for key in (*slots, *WHOLE_LIST))]
    listed = LISTED.findall(text)
    return likely or objects or ([{"all": listed}] if listed else [])


def _json_values(text: str) -> Iterator[Any]:
    """Objects, and lists of texts or objects, that are not empty, from left to right, not those inside another."""
    decoder = json.JSONDecoder()
    place = 0
    for _ in range(MOST_STARTS):
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
    """(slot, entry) of every list that was asked for."""
    found = False
    for slot, count in slots.items():
        rows = document.get(slot)
        if rows is None and slot == "all":
            rows = next((document[key] for key in WHOLE_LIST if key in document), None)
        if rows is None or not count:
            continue
        found = True
        for row in (rows if isinstance(rows, list) else [rows])[:MOST_ENTRIES]:
            entry = validated(row)
            if isinstance(entry, str):
                problems.append(f"one entry of `{slot}` was refused: {entry}")
            else:
                yield slot, entry
    if not found:
        problems.append(f"the JSON object has none of the lists {', '.join(slots)}")


def validated(row: Any) -> Entry | str:
    """An entry of the schema, or what is wrong with it."""
    pydantic = require("pydantic", "llm", "Checking what a language model answers")
    values = {"text": row} if isinstance(row, str) else row
    try:
        return cast(Entry, _entry_model().model_validate(values))
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        return f"`{'.'.join(map(str, first['loc'])) or 'entry'}`: {first['msg']}"


def _entry_model() -> Any:
    from gsopt.llm_prompts.reply_model import EntryModel

    return EntryModel


def _prompt(slot: str, entry: Entry, wish: Wish, source: str, counter: Counter) -> Prompt:
    """Raises Unusable."""
    negative = slot == "negative"
    text = cleaned(entry.text, fewest_words=1 if negative else 3)
    if not negative and not names(text, wish.object):
        raise Unusable(f'it does not name the object "{wish.object}"')
    if OTHER_VIEW.search(text):
        raise Unusable("it speaks of a camera view, which is added later")
    if counter.count(text) > LONGEST:
        raise Unusable(f"it has {counter.count(text)} CLIP tokens, more than {LONGEST}")
    why = cleaned_rationale(entry.why)
    if negative:
        return Prompt(text, polarity="negative", source=source, rationale=why)
    return Prompt(text, view=cast(View, slot), source=source, rationale=why)
