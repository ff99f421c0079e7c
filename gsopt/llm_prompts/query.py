"""Queries a language model: requests without unsupported features, at most two repairs, and a record."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from gsopt.errors import InputError
from gsopt.events import Report
from gsopt.llm_prompts.client import Completion, Server, ServerError, chat
from gsopt.llm_prompts.expand import PromptSpec, slot_of
from gsopt.llm_prompts.reply import ParsedReply, read_reply, reply_schema
from gsopt.llm_prompts.subject import with_article
from gsopt.llm_prompts.templates import Template, fill
from gsopt.llm_prompts.tokens import TokenCounter
from gsopt.sds.prompts import Prompt

REPAIRS = 2
TOKENS_PER_PROMPT = 90
"""Token budget per prompt of the reply: 40 words, the reason and the JSON around them."""
LENGTH_FACTOR = 4
"""Factor on the length limit after a model spent all of it on reasoning."""
MAX_QUOTED_CHARACTERS = 8000
"""Characters of the model's reply that a repair request quotes."""
MAX_RECORDED_CHARACTERS = 64 << 10
"""Characters of a reply that are recorded."""
UNSUPPORTED_STATUSES = (400, 415, 422, 500, 501)
"""HTTP status codes for requests with unsupported fields or images."""
SLOT_TASKS = {
    "all": "describe the whole object",
    "front": "describe what of it is seen from the front",
    "side": "describe what of it is seen from the side",
    "back": "describe what of it is seen from behind, which the photos may not show",
    "top": "describe what of it is seen from above",
    "negative": "say what a good picture of it must not show",
}


@dataclass(frozen=True)
class QuerySettings:
    """Settings of one conversation."""

    template: Template
    spec: PromptSpec
    temperature: float = 0.8
    seed: int = 0
    images: tuple[bytes, ...] = ()
    """JPEG files of the object, for multimodal models."""


@dataclass(frozen=True)
class Round:
    """One request and its reply, as recorded beside prompts.json."""

    asked: str
    answer: str
    tokens_in: int | None
    tokens_out: int | None
    seconds: float
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Conversation:
    """All rounds with a model and the prompts of them."""

    prompts: tuple[Prompt, ...]
    rounds: tuple[Round, ...]
    notes: tuple[str, ...]
    """Unsupported features of the server and rejected entries."""

    @property
    def tokens(self) -> tuple[int | None, int | None]:
        """Input and output tokens, each `None` if the server does not count them."""
        counts = [[r.tokens_in for r in self.rounds], [r.tokens_out for r in self.rounds]]
        first, second = (None if None in side else sum(filter(None, side)) for side in counts)
        return first, second

    @property
    def seconds(self) -> float:
        return sum(r.seconds for r in self.rounds)


def converse(server: Server, settings: QuerySettings, counter: TokenCounter, report: Report) -> Conversation:
    """Requests prompts, and again those that are missing. Raises ServerError without any usable response.

    An error after the first round keeps the prompts so far.
    """
    spec, source = settings.spec, source_of(server.model)
    messages = first_messages(settings)
    prompts: tuple[Prompt, ...] = ()
    rounds: list[Round] = []
    notes: list[str] = []
    sender = ChatSender(server, settings)
    for attempt in range(1 + REPAIRS):
        try:
            answer = sender.send(messages)
        except ServerError as refusal:
            if not rounds:
                raise
            notes.append(f"the repair failed: {refusal}")
            break
        read = read_reply(answer.text, spec, source, counter, prompts)
        prompts += trimmed(read.prompts, prompts, spec)
        problems = read.problems + (("the answer was cut off: too long",) if answer.finish == "length" else ())
        rounds.append(_round(messages, answer, problems))
        if answer.finish == "length" and is_cut_in_reasoning(answer.text):
            sender.room *= LENGTH_FACTOR
        lacking = missing(prompts, spec)
        report(f"answer {attempt + 1}: {len(prompts)} prompts so far, {sum(lacking.values())} missing")
        if not lacking:
            break
        messages = [*messages[:2], *repair_messages(answer, replace(read, problems=problems), lacking, spec)]
    notes += sender.notes + [problem for r in rounds for problem in r.problems]
    return Conversation(prompts, tuple(rounds), tuple(dict.fromkeys(notes)))


def is_cut_in_reasoning(text: str) -> bool:
    """True if the reply was cut off during reasoning."""
    return not text.strip() or ("<think" in text and "</think" not in text)


def source_of(model: str) -> str:
    """Returns llm:MODEL with a name valid in the schema. Raises InputError for a name without printable characters."""
    name = "".join(c if c.isprintable() and not c.isspace() and c not in "<>" else "_" for c in model)[:200]
    if not name.strip("_"):
        raise InputError(f"`--model` must be a name, got {model!r:.80}. Give the one that the server lists.")
    return f"llm:{name}"


def missing(prompts: Sequence[Prompt], spec: PromptSpec) -> dict[str, int]:
    """Returns the number of missing prompts per slot."""
    lacking = {slot: count - sum(slot_of(p) == slot for p in prompts) for slot, count in spec.slots.items()}
    return {slot: count for slot, count in lacking.items() if count > 0}


def trimmed(new: Sequence[Prompt], kept: Sequence[Prompt], spec: PromptSpec) -> tuple[Prompt, ...]:
    """Returns the new prompts without those beyond the requested number per slot."""
    room = missing(kept, spec)
    taken = []
    for prompt in new:
        if room.get(slot_of(prompt), 0) > 0:
            room[slot_of(prompt)] -= 1
            taken.append(prompt)
    return tuple(taken)


class ChatSender:
    """Sends requests with all features first, then without those that the server rejects."""

    def __init__(self, server: Server, settings: QuerySettings) -> None:
        self._server, self._request = server, settings
        self._steps = ["all", "without a schema", "plain"]
        if settings.images:
            self._steps.append("words only")
        self.notes: list[str] = []
        self.room = 1
        """Factor on the length limit of replies."""

    def send(self, messages: list[dict[str, Any]]) -> Completion:
        """Returns one completion. Raises ServerError."""
        while True:
            try:
                return chat(self._server, self._body(messages))
            except ServerError as refusal:
                if refusal.status not in UNSUPPORTED_STATUSES or len(self._steps) == 1:
                    raise
                refused = self._steps.pop(0)
                self.notes.append(
                    f"the server rejected ({refusal.status}) a request {FEATURES[refused]}; sent a simpler one"
                )

    def _body(self, messages: list[dict[str, Any]]) -> dict[str, Any]:
        step, settings = self._steps[0], self._request
        images = () if step == "words only" else settings.images
        body: dict[str, Any] = {"messages": [_with_images(messages[0], ()), _with_images(messages[1], images)]}
        body["messages"] += messages[2:]
        if step in ("all", "without a schema"):
            most = self.room * (200 + TOKENS_PER_PROMPT * sum(settings.spec.slots.values()))
            body |= {"temperature": settings.temperature, "top_p": 0.95, "seed": settings.seed, "max_tokens": most}
        if step == "all":
            schema = {"name": "prompts", "strict": True, "schema": reply_schema(settings.spec.slots)}
            body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return {**body, "stream": False}


FEATURES = {
    "all": "for structured output",
    "without a schema": "with sampling settings",
    "plain": "with pictures",
    "words only": "in words alone",
}


def first_messages(settings: QuerySettings) -> list[dict[str, Any]]:
    """Returns the template's system text and its task, with filled slots."""
    spec, lists = settings.spec, settings.template.lists
    own = {"notes": spec.notes, "object": spec.object, "a_object": with_article(spec.object)}
    values = {
        **own,
        "domain": settings.template.title,
        "questions": "\n".join(f"- {fill(question, own)}" for question in lists["questions"]),
        "rewriting": "\n".join(f"- {example}" for example in lists["rewriting"]),
        "reply": example_reply(spec),
        "wanted": wanted(spec.slots),
    }
    task = fill(settings.template.task, values)
    return [{"role": "system", "content": fill(settings.template.system, own)}, {"role": "user", "content": task}]


def example_reply(spec: PromptSpec) -> str:
    """Returns an example of the reply."""
    slots = [slot for slot, count in spec.slots.items() if count]
    lists = ", ".join(f'"{slot}": [{{"text": "...", "why": "..."}}]' for slot in slots)
    return "{" + lists + "}"


def wanted(slots: dict[str, int]) -> str:
    """Returns the requested number of entries per list, with their subject."""
    return "\n".join(f"- {count} in `{slot}`: {SLOT_TASKS[slot]}" for slot, count in slots.items() if count)


def repair_messages(
    answer: Completion, read: ParsedReply, lacking: dict[str, int], spec: PromptSpec
) -> list[dict[str, Any]]:
    """Returns the reply and a request that names its problems."""
    problems = "\n".join(f"- {problem}" for problem in read.problems) or "- too few entries"
    text = (
        f"That cannot be used as it is:\n{problems}\n\nAnswer with one JSON object and nothing else, only with what is "
        f'still missing. Name the "{spec.object}" in every description. Shape: {example_reply(spec)}\n{wanted(lacking)}'
    )
    quote = answer.text[:MAX_QUOTED_CHARACTERS] or "(nothing)"
    return [{"role": "assistant", "content": quote}, {"role": "user", "content": text}]


def _with_images(message: dict[str, Any], images: Sequence[bytes]) -> dict[str, Any]:
    if not images:
        return message
    urls = [f"data:image/jpeg;base64,{base64.b64encode(image).decode()}" for image in images]
    parts: list[dict[str, Any]] = [{"type": "text", "text": message["content"]}]
    return {**message, "content": parts + [{"type": "image_url", "image_url": {"url": url}} for url in urls]}


def _round(messages: list[dict[str, Any]], answer: Completion, problems: tuple[str, ...]) -> Round:
    asked = "\n\n".join(f"[{message['role']}]\n{message['content']}" for message in messages)
    return Round(
        asked=asked[:MAX_RECORDED_CHARACTERS],
        answer=answer.text[:MAX_RECORDED_CHARACTERS],
        tokens_in=answer.tokens_in,
        tokens_out=answer.tokens_out,
        seconds=round(answer.seconds, 3),
        problems=problems,
    )
