"""prompts.json: descriptions of an object by an expert, a template or a language model. No torch, no package.

    {"version": 1, "notes": "femur, osteoporotic, CT", "object": "femur", "domain": "medicine", "reviewed": false,
     "made": {"source": "template", "template": "medicine", "raw": "", "warnings": []},
     "prompts": [{"text": "a worn oak chair", "weight": 1.0, "view": "all", "polarity": "positive",
                  "source": "user", "rationale": "", "score": null}],
     "images": [{"file": "prompts-images/01.png", "prompt": "a worn oak chair", "source": "sd21", "accepted": false}]}

`version`, `prompts` and the `text` of each are required, all else is optional; prompts.schema.json beside this module
is its JSON Schema. The file is untrusted: bounded in size and number, unknown keys refused by name, no control
characters in the texts, no path that leaves the file's folder.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from gsopt.config.from_json import MAX_JSON_NUMBER
from gsopt.errors import InputError, shortened
from gsopt.events import to_json, write_atomic

VERSION = 1
MAX_FILE_BYTES = 1 << 20
"""Size limit of the file, bytes."""
MAX_PROMPTS = 256
MAX_TEXT_LENGTH = 1000
"""Length limit of a prompt, characters. CLIP reads 77 tokens, about 300 characters."""
MAX_RATIONALE_LENGTH = 4000
MAX_NOTES_LENGTH = 4000
MAX_NAME_LENGTH = 200
MAX_WEIGHT = 1000.0
MAX_IMAGES = 64
MAX_WARNINGS = 64

View = Literal["all", "front", "side", "back", "top"]
Polarity = Literal["positive", "negative"]
SOURCE = re.compile(r"user|template|llm:[^\s<>]{1,200}")
FILE = re.compile(r"(\w[\w .-]{0,99}/)?\w[\w .-]{0,99}")
"""A file beside prompts.json or one folder below it."""


@dataclass(frozen=True)
class Prompt:
    """One description and its source."""

    text: str
    weight: float = 1.0
    """Weight relative to the other prompts of the same polarity; 0 disables it."""
    view: View = "all"
    """Side of the object that it describes."""
    polarity: Polarity = "positive"
    source: str = "user"
    """One of user, template or llm:MODEL."""
    rationale: str = ""
    """The author's reason."""
    score: float | None = None
    """CLIP alignment with the input views, `None` if not measured."""

    def __post_init__(self) -> None:
        _require_text(self.text, "text", MAX_TEXT_LENGTH)
        if not self.text.strip():
            raise InputError("A prompt is empty, got only white space. Say what the object is, or drop the prompt.")
        _require_text(self.rationale, "rationale", MAX_RATIONALE_LENGTH)
        _require_number(self.weight, "weight", 0.0, MAX_WEIGHT)
        if self.score is not None:
            _require_number(self.score, "score", -1.0, 1.0)
        _require_one_of(self.view, "view", get_args(View))
        _require_one_of(self.polarity, "polarity", get_args(Polarity))
        _require_source(self.source)


@dataclass(frozen=True)
class ReferenceImage:
    """A reference image that a text-to-image model made from a prompt."""

    file: str
    """Path of the PNG, relative to the folder of prompts.json, at most one folder below."""
    prompt: str = ""
    source: str = ""
    """Name of the prior that generated it."""
    accepted: bool = False
    """True if the expert accepted it; others are not used for guidance."""

    def __post_init__(self) -> None:
        _require_file(self.file, "file")
        _require_text(self.prompt, "prompt", MAX_TEXT_LENGTH)
        _require_text(self.source, "source", MAX_NAME_LENGTH)
        _require_bool(self.accepted, "accepted")


@dataclass(frozen=True)
class Provenance:
    """Origin of a prompt set."""

    source: str = "user"
    """Requested source: user, template or llm:MODEL. Each prompt has its own source."""
    template: str = ""
    """Name of the template."""
    raw: str = ""
    """File with the model's unmodified replies, beside prompts.json."""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _require_source(self.source)
        _require_text(self.template, "template", MAX_NAME_LENGTH)
        if self.raw:
            _require_file(self.raw, "raw")
        if not isinstance(self.warnings, (tuple, list)) or len(self.warnings) > MAX_WARNINGS:
            raise InputError(f"`warnings` must be a list of at most {MAX_WARNINGS} texts. Remove some.")
        for warning in self.warnings:
            _require_text(warning, "warnings", MAX_RATIONALE_LENGTH)
        object.__setattr__(self, "warnings", tuple(self.warnings))


@dataclass(frozen=True)
class PromptSet:
    """The contents of a prompts.json."""

    prompts: tuple[Prompt, ...] = ()
    notes: str = ""
    """The expert's own words."""
    object: str = ""
    """The object in a noun or two, which every prompt of a model contains."""
    domain: str = ""
    reviewed: bool = False
    """True if an expert has reviewed every prompt."""
    made: Provenance | None = None
    images: tuple[ReferenceImage, ...] = ()

    def __post_init__(self) -> None:
        _require_text(self.notes, "notes", MAX_NOTES_LENGTH)
        _require_text(self.object, "object", MAX_NAME_LENGTH)
        _require_text(self.domain, "domain", MAX_NAME_LENGTH)
        _require_bool(self.reviewed, "reviewed")


def read_prompts(path: Path) -> tuple[Prompt, ...]:
    """Reads the prompts of a file, in its order. Raises InputError that names the file, the prompt and the error."""
    return read_set(path).prompts


def read_set(path: Path) -> PromptSet:
    """Reads the whole file. Raises InputError that names the file, the entry and the error."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ValueError(f"larger than {MAX_FILE_BYTES} bytes")
        document = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read the prompts in {path}: {error}. Write them with `gsopt prompts`.") from error
    try:
        return set_from(document)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def prompts_from(document: Any) -> tuple[Prompt, ...]:
    """Returns the prompts of a parsed prompts.json; raises InputError if it violates the schema."""
    return set_from(document).prompts


def set_from(document: Any) -> PromptSet:
    """Converts a parsed prompts.json; raises InputError if it violates the schema."""
    if not isinstance(document, dict) or not isinstance(document.get("prompts"), list):
        raise InputError('An object with a list `prompts` is needed. Write {"version": 1, "prompts": [...]}.')
    version = document.get("version")
    if version != VERSION or isinstance(version, bool):
        raise InputError(f"Version {shortened(version)} of prompts is not known, only {VERSION}. Update gsopt.")
    _require_known(document, ("version", *_names(PromptSet)), "The file")
    images = document.get("images", [])
    if len(document["prompts"]) > MAX_PROMPTS:
        raise InputError(f"At most {MAX_PROMPTS} prompts are read, got {len(document['prompts'])}. Remove some.")
    if not isinstance(images, list) or len(images) > MAX_IMAGES:
        raise InputError(f"`images` must be a list of at most {MAX_IMAGES} pictures. Remove some.")
    made = document.get("made")
    plain = {name: document[name] for name in ("notes", "object", "domain", "reviewed") if name in document}
    return PromptSet(
        prompts=tuple(_entry(Prompt, values, f"Prompt {i}", "text") for i, values in enumerate(document["prompts"])),
        images=tuple(_entry(ReferenceImage, values, f"Image {i}", "file") for i, values in enumerate(images)),
        made=None if made is None else _entry(Provenance, made, "`made`", "source"),
        **plain,
    )


def prompts_document(prompts: Iterable[Prompt]) -> dict[str, Any]:
    """Returns JSON values; `prompts_from` is the inverse."""
    return {"version": VERSION, "prompts": [asdict(prompt) for prompt in prompts]}


def set_document(prompt_set: PromptSet) -> dict[str, Any]:
    """Returns JSON values; `set_from` is the inverse."""
    values = asdict(prompt_set)
    first = {name: values[name] for name in ("notes", "object", "domain", "reviewed", "made")}
    return {"version": VERSION, **first, "prompts": list(values["prompts"]), "images": list(values["images"])}


def write_prompts(path: Path, prompts: Iterable[Prompt]) -> None:
    """Writes prompts.json atomically."""
    write_atomic(path, to_json(prompts_document(prompts)))


def write_set(path: Path, prompt_set: PromptSet) -> None:
    """Writes prompts.json atomically."""
    write_atomic(path, to_json(set_document(prompt_set)))


def accepted_images(path: Path) -> tuple[Path, ...]:
    """Returns the paths of accepted reference images. Raises InputError for a file that violates the schema."""
    return tuple(path.parent / picture.file for picture in read_set(path).images if picture.accepted)


_T = TypeVar("_T")


def _entry(kind: Callable[..., _T], values: Any, name: str, needed: str) -> _T:
    if not isinstance(values, dict) or needed not in values:
        raise InputError(f"{name} must be an object with a `{needed}`, got {shortened(values)}. Correct it.")
    _require_known(values, _names(kind), name)
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _require_known(values: dict[str, Any], known: tuple[str, ...], name: str) -> None:
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise InputError(f"{name} has the unknown key `{unknown[0]:.80}`. Known keys: {', '.join(known)}.")


def _require_text(value: Any, name: str, longest: int) -> None:
    if not isinstance(value, str):
        raise InputError(f"`{name}` must be text, got {shortened(value)}. Put it in quotes.")
    if len(value) > longest:
        raise InputError(f"`{name}` may have {longest} characters, got {len(value)} ({value[:30]!r}...). Shorten it.")
    control = next((c for c in value if unicodedata.category(c) in ("Cc", "Cs") and c not in "\n\t"), None)
    if control is not None:
        raise InputError(f"`{name}` holds the control character {control!r}. Remove it.")


def _require_number(value: Any, name: str, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < MAX_JSON_NUMBER:
        raise InputError(f"`{name}` must be a number, got {shortened(value)}. Correct it.")
    if not low <= value <= high:
        raise InputError(f"`{name}` must lie in [{low:g}, {high:g}], got {value}. Correct it.")


def _require_one_of(value: Any, name: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"`{name}` must be one of {', '.join(allowed)}; got {shortened(value)}. Pick one.")


def _require_source(value: Any) -> None:
    if not isinstance(value, str) or not SOURCE.fullmatch(value):
        raise InputError(
            f"`source` of a prompt must be user, template or llm:MODEL, got {shortened(value)}. Correct it."
        )


def _require_file(value: Any, name: str) -> None:
    if not isinstance(value, str) or not FILE.fullmatch(value):
        raise InputError(
            f"`{name}` must name a file beside prompts.json or one folder below, got {shortened(value)}. Letters, "
            "digits, spaces, dots, - and _ may be used."
        )


def _require_bool(value: Any, name: str) -> None:
    if not isinstance(value, bool):
        raise InputError(f"`{name}` must be true or false, got {shortened(value)}. Correct it.")
