"""Asking a language model: the request, what a server does not take left out, at most two repairs, and a record."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.llm_prompts.client import Answer, Refusal, Server, chat
from gsopt.llm_prompts.expand import Wish, slot_of
from gsopt.llm_prompts.reply import Read, read_reply, reply_schema
from gsopt.llm_prompts.schema import Prompt
from gsopt.llm_prompts.subject import with_article
from gsopt.llm_prompts.templates import Template, fill
from gsopt.llm_prompts.tokens import Counter

REPAIRS = 2
TOKENS_PER_PROMPT = 90
"""Allowed per prompt of the reply: 40 words, the reason and the JSON around them."""
MORE_ROOM = 4
"""How much longer an answer may be after a model spent all on its thoughts."""
LONGEST_QUOTE = 8000
"""Characters of the model's own answer that a repair sends back to it."""
LONGEST_RECORD = 64 << 10
"""Characters of an answer that are kept."""
NOT_TAKEN = (400, 415, 422, 500, 501)
"""How servers answer to a request with fields or pictures they do not know."""
FRONT_WORDS = {
    "all": "describe the whole object",
    "front": "describe what of it is seen from the front",
    "side": "describe what of it is seen from the side",
    "back": "describe what of it is seen from behind, which the photos may not show",
    "top": "describe what of it is seen from above",
    "negative": "say what a good picture of it must not show",
}


@dataclass(frozen=True)
class Request:
    """One conversation's settings."""

    template: Template
    wish: Wish
    temperature: float = 0.8
    seed: int = 0
    pictures: tuple[bytes, ...] = ()
    """JPEG files of the object, for models that see."""


@dataclass(frozen=True)
class Round:
    """One request and its answer, as they are kept beside prompts.json."""

    asked: str
    answer: str
    tokens_in: int | None
    tokens_out: int | None
    seconds: float
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Conversation:
    """What a model gave, in all its rounds."""

    prompts: tuple[Prompt, ...]
    rounds: tuple[Round, ...]
    notes: tuple[str, ...]
    """What the server does not take, what was refused."""

    @property
    def tokens(self) -> tuple[int | None, int | None]:
        """In and out; None where the server does not count."""
        counts = [[r.tokens_in for r in self.rounds], [r.tokens_out for r in self.rounds]]
        first, second = (None if None in side else sum(filter(None, side)) for side in counts)
        return first, second

    @property
    def seconds(self) -> float:
        return sum(r.seconds for r in self.rounds)


def converse(server: Server, request: Request, counter: Counter, report: Report) -> Conversation:
    """Ask, and ask again for what is missing. Raises Refusal where the server gives no usable HTTP answer at all.

    A refusal after the first round keeps what is there.
    """
    wish, source = request.wish, source_of(server.model)
    messages = first_messages(request)
    prompts: tuple[Prompt, ...] = ()
    rounds: list[Round] = []
    notes: list[str] = []
    way = Way(server, request)
    for attempt in range(1 + REPAIRS):
        try:
            answer = way.ask(messages)
        except Refusal as refusal:
            if not rounds:
                raise
            notes.append(f"the repair failed: {refusal}")
            break
        read = read_reply(answer.text, wish, source, counter, prompts)
        prompts += trimmed(read.prompts, prompts, wish)
        problems = read.problems + (("the answer was cut off: too long",) if answer.finish == "length" else ())
        rounds.append(_round(messages, answer, problems))
        if answer.finish == "length" and is_thought(answer.text):
            way.room *= MORE_ROOM
        lacking = missing(prompts, wish)
        report(f"answer {attempt + 1}: {len(prompts)} prompts so far, {sum(lacking.values())} missing")
        if not lacking:
            break
        messages = [*messages[:2], *repair_messages(answer, replace(read, problems=problems), lacking, wish)]
    notes += way.notes + [problem for r in rounds for problem in r.problems]
    return Conversation(prompts, tuple(rounds), tuple(dict.fromkeys(notes)))


def is_thought(text: str) -> bool:
    """Whether a model that reasons first was cut off before it began to answer."""
    return not text.strip() or ("<think" in text and "</think" not in text)


def source_of(model: str) -> str:
    """llm:MODEL with a name that the schema takes. InputError for one that holds nothing printable."""
    name = "".join(c if c.isprintable() and not c.isspace() and c not in "<>" else "_" for c in model)[:200]
    if not name.strip("_"):
        raise InputError(f"`--model` must be a name, got {model!r:.80}. Give the one that the server lists.")
    return f"llm:{name}"


def missing(prompts: Sequence[Prompt], wish: Wish) -> dict[str, int]:
    """What is still to be had, per slot."""
    lacking = {slot: count - sum(slot_of(p) == slot for p in prompts) for slot, count in wish.slots.items()}
    return {slot: count for slot, count in lacking.items() if count > 0}


def trimmed(new: Sequence[Prompt], kept: Sequence[Prompt], wish: Wish) -> tuple[Prompt, ...]:
    """No more per slot than asked for."""
    room = missing(kept, wish)
    taken = []
    for prompt in new:
        if room.get(slot_of(prompt), 0) > 0:
            room[slot_of(prompt)] -= 1
            taken.append(prompt)
    return tuple(taken)


class Way:
    """How this server is to be asked: everything at first, then without what it refuses."""

    def __init__(self, server: Server, request: Request) -> None:
        self._server, self._request = server, request
        self._steps = ["all", "without a schema", "plain"]
        if request.pictures:
            self._steps.append("words only")
        self.notes: list[str] = []
        self.room = 1
        """Factor on the length that an answer may have."""

    def ask(self, messages: list[dict[str, Any]]) -> Answer:
        """One answer. Raises Refusal."""
        while True:
            try:
                return chat(self._server, self._body(messages))
            except Refusal as refusal:
                if refusal.status not in NOT_TAKEN or len(self._steps) == 1:
                    raise
                refused = self._steps.pop(0)
                self.notes.append(
                    f"the server refused ({refusal.status}) to be asked {WAYS[refused]}; asked more plainly"
                )

    def _body(self, messages: list[dict[str, Any]]) -> dict[str, Any]:
        step, request = self._steps[0], self._request
        pictures = () if step == "words only" else request.pictures
        body: dict[str, Any] = {"messages": [_with_pictures(messages[0], ()), _with_pictures(messages[1], pictures)]}
        body["messages"] += messages[2:]
        if step in ("all", "without a schema"):
            most = self.room * (200 + TOKENS_PER_PROMPT * sum(request.wish.slots.values()))
            body |= {"temperature": request.temperature, "top_p": 0.95, "seed": request.seed, "max_tokens": most}
        if step == "all":
            schema = {"name": "prompts", "strict": True, "schema": reply_schema(request.wish.slots)}
            body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return {**body, "stream": False}


WAYS = {
    "all": "for structured output",
    "without a schema": "with sampling settings",
    "plain": "with pictures",
    "words only": "in words alone",
}


def first_messages(request: Request) -> list[dict[str, Any]]:
    """The template's system text and its task, filled."""
    wish, lists = request.wish, request.template.lists
    own = {"notes": wish.notes, "object": wish.object, "a_object": with_article(wish.object)}
    values = {
        **own,
        "domain": request.template.title,
        "questions": "\n".join(f"- {fill(question, own)}" for question in lists["questions"]),
        "rewriting": "\n".join(f"- {example}" for example in lists["rewriting"]),
        "reply": example_reply(wish),
        "wanted": wanted(wish.slots),
    }
    task = fill(request.template.task, values)
    return [{"role": "system", "content": fill(request.template.system, own)}, {"role": "user", "content": task}]


def example_reply(wish: Wish) -> str:
    """The shape of the reply."""
    slots = [slot for slot, count in wish.slots.items() if count]
    lists = ", ".join(f'"{slot}": [{{"text": "...", "why": "..."}}]' for slot in slots)
    return "{" + lists + "}"


def wanted(slots: dict[str, int]) -> str:
    """How many entries each list has, and what they are about."""
    return "\n".join(f"- {count} in `{slot}`: {FRONT_WORDS[slot]}" for slot, count in slots.items() if count)


def repair_messages(answer: Answer, read: Read, lacking: dict[str, int], wish: Wish) -> list[dict[str, Any]]:
    """The answer and what is wrong with it."""
    problems = "\n".join(f"- {problem}" for problem in read.problems) or "- too few entries"
    text = (
        f"That cannot be used as it is:\n{problems}\n\nAnswer with one JSON object and nothing else, only with what is "
        f'still missing. Name the "{wish.object}" in every description. Shape: {example_reply(wish)}\n{wanted(lacking)}'
    )
    said = answer.text[:LONGEST_QUOTE] or "(nothing)"
    return [{"role": "assistant", "content": said}, {"role": "user", "content": text}]


def _with_pictures(message: dict[str, Any], pictures: Sequence[bytes]) -> dict[str, Any]:
    if not pictures:
        return message
    urls = [f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}" for picture in pictures]
    parts: list[dict[str, Any]] = [{"type": "text", "text": message["content"]}]
    return {**message, "content": parts + [{"type": "image_url", "image_url": {"url": url}} for url in urls]}


def _round(messages: list[dict[str, Any]], answer: Answer, problems: tuple[str, ...]) -> Round:
    asked = "\n\n".join(f"[{message['role']}]\n{message['content']}" for message in messages)
    return Round(
        asked=asked[:LONGEST_RECORD],
        answer=answer.text[:LONGEST_RECORD],
        tokens_in=answer.tokens_in,
        tokens_out=answer.tokens_out,
        seconds=round(answer.seconds, 3),
        problems=problems,
    )
