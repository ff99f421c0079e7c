"""prompts.json: what an expert, a template or a language model says about an object. No torch, no package.

    {"version": 1, "prompts": [{"text": "a worn oak chair", "weight": 1.0, "view": "all", "polarity": "positive",
                                "source": "user", "rationale": "", "score": null}]}

Everything but `text` may be left out. The file is untrusted: bounded in size and number, unknown keys refused by name,
no control characters in the texts.
"""

from __future__ import annotations

import json
import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from gsopt.errors import InputError
from gsopt.events import to_json, write_atomic

VERSION = 1
LARGEST_FILE = 1 << 20
"""Bytes that are read."""
MOST_PROMPTS = 256
LONGEST_TEXT = 1000
"""Characters of a prompt. CLIP reads 77 tokens, about 300 characters."""
LONGEST_RATIONALE = 4000
LARGEST_WEIGHT = 1000.0

View = Literal["all", "front", "side", "back", "top"]
Polarity = Literal["positive", "negative"]
SOURCE = re.compile(r"user|template|llm:[^\s<>]{1,200}")


@dataclass(frozen=True)
class Prompt:
    """One description, and where it comes from."""

    text: str
    weight: float = 1.0
    """Relative to the other prompts of the same polarity; 0 keeps it out."""
    view: View = "all"
    """From where the object looks like this."""
    polarity: Polarity = "positive"
    source: str = "user"
    """user, template or llm:MODEL."""
    rationale: str = ""
    """Why whoever wrote it wrote it."""
    score: float | None = None
    """CLIP alignment with the input views, None where nobody measured it."""

    def __post_init__(self) -> None:
        _require_text(self.text, "text", LONGEST_TEXT)
        if not self.text.strip():
            raise InputError("A prompt is empty, got only white space. Say what the object is, or drop the prompt.")
        _require_text(self.rationale, "rationale", LONGEST_RATIONALE)
        _require_number(self.weight, "weight", 0.0, LARGEST_WEIGHT)
        if self.score is not None:
            _require_number(self.score, "score", -1.0, 1.0)
        _require_one_of(self.view, "view", get_args(View))
        _require_one_of(self.polarity, "polarity", get_args(Polarity))
        if not isinstance(self.source, str) or not SOURCE.fullmatch(self.source):
            raise InputError(
                f"`source` of a prompt must be user, template or llm:MODEL, got {self.source!r}. Correct it."
            )


def read_prompts(path: Path) -> tuple[Prompt, ...]:
    """The prompts of a file, in its order. Raises InputError that names the file, the prompt and what is wrong."""
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST_FILE + 1)
        if len(data) > LARGEST_FILE:
            raise ValueError(f"larger than {LARGEST_FILE} bytes")
        document = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read the prompts in {path}: {error}. Write them with `gsopt prompts`.") from error
    try:
        return prompts_from(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def prompts_from(document: Any) -> tuple[Prompt, ...]:
    """The prompts of a parsed prompts.json; InputError when it does not follow the schema."""
    if not isinstance(document, dict) or not isinstance(document.get("prompts"), list):
        raise InputError('An object with a list `prompts` is needed. Write {"version": 1, "prompts": [...]}.')
    if document.get("version") != VERSION:
        raise InputError(f"Version {document.get('version')!r} of prompts is not known, only {VERSION}. Update gsopt.")
    if len(document["prompts"]) > MOST_PROMPTS:
        raise InputError(f"At most {MOST_PROMPTS} prompts are read, got {len(document['prompts'])}. Remove some.")
    return tuple(_prompt(values, number) for number, values in enumerate(document["prompts"]))


def prompts_document(prompts: Iterable[Prompt]) -> dict[str, Any]:
    """JSON-ready; `prompts_from` is its inverse."""
    return {"version": VERSION, "prompts": [asdict(prompt) for prompt in prompts]}


def write_prompts(path: Path, prompts: Iterable[Prompt]) -> None:
    """A whole prompts.json or nothing."""
    write_atomic(path, to_json(prompts_document(prompts)))


def _prompt(values: Any, number: int) -> Prompt:
    if not isinstance(values, dict) or "text" not in values:
        raise InputError(f"Prompt {number} must be an object with a `text`, got {values!r:.80}. Correct it.")
    known = [field.name for field in fields(Prompt)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise InputError(f"Prompt {number} has the unknown key `{unknown[0]}`. Known keys: {', '.join(known)}.")
    try:
        return Prompt(**values)
    except InputError as error:
        raise InputError(f"Prompt {number}: {error}") from error


def _require_text(value: Any, name: str, longest: int) -> None:
    if not isinstance(value, str):
        raise InputError(f"`{name}` of a prompt must be text, got {value!r:.80}. Put it in quotes.")
    if len(value) > longest:
        raise InputError(
            f"`{name}` of a prompt may have {longest} characters, got {len(value)} ({value[:30]!r}...). Shorten it: "
            "CLIP reads 77 tokens."
        )
    control = next((c for c in value if unicodedata.category(c) in ("Cc", "Cs") and c not in "\n\t"), None)
    if control is not None:
        raise InputError(f"`{name}` of a prompt holds the control character {control!r}. Remove it.")


def _require_number(value: Any, name: str, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise InputError(f"`{name}` of a prompt must be a number, got {value!r:.80}. Correct it.")
    if not low <= value <= high:
        raise InputError(f"`{name}` of a prompt must lie in [{low:g}, {high:g}], got {value}. Correct it.")


def _require_one_of(value: Any, name: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"`{name}` of a prompt must be one of {', '.join(allowed)}; got {value!r:.80}. Pick one.")
