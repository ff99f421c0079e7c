"""prompts.json, the file that `gsopt prompts` writes and `gsopt train --prompts` reads (its schema is gsopt's).

Everything beside the prompts (notes, domain, how they were made, images) is kept and written back.
"""

from __future__ import annotations

import os
import re
import unicodedata
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from .errors import InputError
from .files import encoded, json_object, read_json, write_json

VERSION = 1
LARGEST_FILE = 1 << 20
MOST_PROMPTS = 256
LONGEST_TEXT = 1000
LONGEST_RATIONALE = 4000
LARGEST_WEIGHT = 1000.0
VIEWS = ("all", "front", "side", "back", "top")
POLARITIES = ("positive", "negative")
DOMAINS = ("generic", "medicine", "robotics", "arvr", "environment")
FILE = re.compile(r"(\w[\w .-]{0,99}/)?\w[\w .-]{0,99}")
"""Beside the file or one folder below."""
SOURCE = re.compile(r"user|template|llm:[^\s<>]{1,200}")


@dataclass(frozen=True)
class Prompt:
    """One description, and where it comes from."""

    text: str
    weight: float = 1.0
    view: str = "all"
    """Side of the object that the prompt describes."""
    polarity: str = "positive"
    source: str = "user"
    """user, template or llm:MODEL."""
    rationale: str = ""
    score: float | None = None
    """CLIP alignment with the input views, None where nobody measured it."""

    def __post_init__(self) -> None:
        require_text(self.text, "text", LONGEST_TEXT)
        require_text(self.rationale, "rationale", LONGEST_RATIONALE)
        if not self.text.strip():
            raise InputError("A prompt is empty. Say what the object is, or remove the prompt.")
        require_number(self.weight, "weight", 0.0, LARGEST_WEIGHT)
        if self.score is not None:
            require_number(self.score, "score", -1.0, 1.0)
        if self.view not in VIEWS or self.polarity not in POLARITIES:
            raise InputError(
                f"A prompt has view {self.view!r:.40} and polarity {self.polarity!r:.40}. Pick known ones."
            )
        require_text(self.source, "source", LONGEST_TEXT)
        if not SOURCE.fullmatch(self.source):
            raise InputError(f"`source` of a prompt must be user, template or llm:MODEL; got {self.source!r:.40}.")


@dataclass(frozen=True)
class Document:
    """The content of a file."""

    prompts: tuple[Prompt, ...]
    rest: dict[str, Any] = field(default_factory=dict)
    """The other keys, untouched."""

    def accepted(self, folder: Path) -> list[Path]:
        """The pictures that were accepted and lie where a file in `folder` says."""
        return [path for path, accepted in self._pictures(folder) if accepted and os.path.isfile(path)]

    def beside(self, folder: Path) -> Document:
        """As a file in `folder` may say it: pictures are named by their place beside it, and only those there are."""
        if all(os.path.isfile(path) for path, _ in self._pictures(folder)):
            return self
        return Document(self.prompts, {key: value for key, value in self.rest.items() if key != "images"})

    def _pictures(self, folder: Path) -> list[tuple[Path, bool]]:
        listed = self.rest.get("images")
        rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
        named = [row for row in rows if isinstance(row.get("file"), str) and FILE.fullmatch(row["file"])]
        return [(folder / row["file"], row.get("accepted") is True) for row in named]


def read_prompts(path: Path) -> Document:
    """InputError that names the file, the prompt and what is wrong."""
    document = read_json(path, LARGEST_FILE)
    try:
        return parse(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse(document: dict[str, Any]) -> Document:
    listed = document.get("prompts")
    if not isinstance(listed, list) or document.get("version") != VERSION:
        raise InputError(f"A list `prompts` and `version` {VERSION} are needed. Write the file with `gsopt prompts`.")
    if len(listed) > MOST_PROMPTS:
        raise InputError(f"At most {MOST_PROMPTS} prompts are read, got {len(listed)}. Remove some.")
    known = {f.name for f in fields(Prompt)}
    prompts = []
    for number, values in enumerate(listed):
        if not isinstance(values, dict) or "text" not in values or set(values) - known:
            raise InputError(f"Prompt {number} must have a `text` and none but {sorted(known)}. Correct it.")
        try:
            prompts.append(Prompt(**values))
        except InputError as error:
            raise InputError(f"Prompt {number}: {error}") from error
    rest = {key: value for key, value in document.items() if key not in ("version", "prompts")}
    encoded(rest)
    return Document(tuple(prompts), rest)


def parse_rest(text: str) -> dict[str, Any]:
    """The other keys of a file, as a .blend keeps them: JSON, empty for none. InputError for anything else."""
    try:
        return json_object(text or "{}")
    except (ValueError, RecursionError) as error:
        raise InputError(f"What this .blend keeps beside its prompts is damaged: {error}. Read them again.") from error


def write_prompts(path: Path, document: Document) -> None:
    """A whole file or the one that was there before."""
    listed = [asdict(prompt) for prompt in document.prompts]
    write_json(path, {"version": VERSION, **document.rest, "prompts": listed})


def require_text(value: Any, name: str, longest: int) -> None:
    if not isinstance(value, str) or len(value) > longest:
        got = f"{len(value)} characters" if isinstance(value, str) else f"{value!r:.40}"
        raise InputError(f"`{name}` of a prompt must be text of at most {longest} characters, got {got}. Shorten it.")
    if any(unicodedata.category(c) in ("Cc", "Cs") and c not in "\n\t" for c in value):
        raise InputError(f"`{name}` of a prompt holds control characters. Remove them.")


def require_number(value: Any, name: str, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e300:
        raise InputError(f"`{name}` of a prompt must be a number, got {value!r:.40}. Correct it.")
    if not low <= value <= high:
        raise InputError(f"`{name}` of a prompt must lie in [{low:g}, {high:g}], got {value:g}. Correct it.")
