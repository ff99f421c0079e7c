"""Templates: one Markdown file per domain, with front matter; a user's own is one more file. No YAML, no package.

    ---
    name: medicine
    title: medicine and anatomy
    extends: generic
    ---
    # System        text: the role of the language model
    # Task          text: its task
    # Questions     lists, one entry per line that begins with "- "
    # Library       questions where the prior is a shape library, which looks for kinds of things
    # Words         - femur @back => description used if the notes have that word (for one view only)

Lists of a template precede those it extends, texts replace them. Slots in braces are filled by plain replacement,
without recursion.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from gsopt.errors import InputError, UsageError
from gsopt.sds.prompts import View

FOLDER = Path(__file__).with_name("templates")
DOMAINS = ("generic", "medicine", "robotics", "arvr", "environment")
MAX_FILE_BYTES = 256 << 10
KEYS = ("name", "title", "extends")
TEXTS = ("system", "task")
LISTS = ("phrases", "front", "side", "back", "top", "negative", "questions", "library", "rewriting")
SECTIONS = (*TEXTS, *LISTS, "words")
SLOT = re.compile(r"\{([a-z_]+)\}")
COMMON_SLOTS = ("notes", "object", "a_object")
TASK_SLOTS = (*COMMON_SLOTS, "domain", "questions", "rewriting", "reply", "wanted")
NAME = re.compile(r"[\w .-]{1,60}")


@dataclass(frozen=True)
class Word:
    """A description for words of the notes."""

    words: tuple[str, ...]
    """Alternative words, lower case."""
    view: View
    description: str


@dataclass(frozen=True)
class Template:
    """Questions, phrases and word descriptions of a domain."""

    name: str
    title: str
    system: str
    task: str
    lists: Mapping[str, tuple[str, ...]]
    """Lists by section, see LISTS."""
    words: tuple[Word, ...]


def load_template(domain: str) -> Template:
    """Loads the template of a domain or a file. Raises UsageError for an unknown name, InputError for a broken file."""
    if domain in DOMAINS:
        return _merged(FOLDER / f"{domain}.md")
    path = Path(domain).expanduser()
    if not path.is_file():
        raise UsageError(
            f"`--domain` must be one of {', '.join(DOMAINS)} or a template file, got {domain!r:.200}. Pick one."
        )
    return _merged(path)


def for_library(template: Template) -> Template:
    """The template with its questions for a shape library first: kind, material, parts, proportions."""
    asked = template.lists["library"] + template.lists["questions"]
    return replace(template, lists={**template.lists, "questions": asked})


def fill(text: str, values: Mapping[str, str]) -> str:
    """Fills the slots of the text in one pass."""
    return SLOT.sub(lambda slot: values.get(slot[1], slot[0]), text)


@dataclass(frozen=True)
class _File:
    """One file, before merging with the one it extends."""

    head: dict[str, str]
    texts: dict[str, str]
    lists: dict[str, tuple[str, ...]]


def _merged(path: Path) -> Template:
    file = _read(path)
    base = file.head.get("extends", "" if file.head["name"] == "generic" else "generic")
    parent = None
    if base:
        if base not in DOMAINS:
            raise InputError(f"{path}: `extends` must be one of {', '.join(DOMAINS)}, got {base!r:.80}. Correct it.")
        if base == file.head["name"] and path.parent == FOLDER:
            raise InputError(f"{path}: the template extends itself, {base}. Name another one.")
        parent = _merged(FOLDER / f"{base}.md")
    texts = {name: file.texts.get(name) or (getattr(parent, name) if parent else "") for name in TEXTS}
    lists = {name: file.lists.get(name, ()) + (parent.lists[name] if parent else ()) for name in LISTS}
    own = tuple(_word(entry, path) for entry in file.lists.get("words", ()))
    return Template(
        name=file.head["name"],
        title=file.head["title"],
        system=texts["system"],
        task=texts["task"],
        lists=lists,
        words=own + (parent.words if parent else ()),
    )


def _read(path: Path) -> _File:
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ValueError(f"larger than {MAX_FILE_BYTES} bytes")
        text = data.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the template {path}: {error}. Give a Markdown file.") from error
    lines = text.splitlines()
    if not lines or lines[0].strip() != "---" or "---" not in (line.strip() for line in lines[1:]):
        raise InputError(f"{path} has no front matter. Begin it with the lines ---, name: NAME, title: TITLE, ---.")
    end = next(i for i, line in enumerate(lines) if i and line.strip() == "---")
    head = _head(lines[1:end], path)
    sections = _sections(lines[end + 1 :], path)
    return _File(
        head,
        {name: _text(sections[name], name, path) for name in TEXTS if name in sections},
        {name: _list(sections[name], name, path) for name in (*LISTS, "words") if name in sections},
    )


def _head(lines: list[str], path: Path) -> dict[str, str]:
    """Parses `key: value` per line."""
    head = {}
    for line in lines:
        key, colon, value = line.partition(":")
        if line.strip() and (not colon or key.strip() not in KEYS):
            raise InputError(f"{path}: front matter holds {', '.join(KEYS)}; got {line!r:.80}. Correct or remove it.")
        if line.strip():
            head[key.strip()] = value.strip()
    if not NAME.fullmatch(head.get("name", "")) or not NAME.fullmatch(head.get("title", "")):
        raise InputError(
            f"{path}: `name` and `title` need 1 to 60 letters, digits, spaces or -_. characters. Add them."
        )
    return head


def _sections(lines: list[str], path: Path) -> dict[str, list[str]]:
    """Returns the lines below each `# Heading`; text before the first is a comment."""
    sections: dict[str, list[str]] = {}
    current: list[str] = []
    for line in lines:
        if line.startswith("# "):
            name = line[2:].strip().lower()
            if name not in SECTIONS or name in sections:
                known = ", ".join(section.title() for section in SECTIONS)
                raise InputError(f"{path}: section {line!r:.80} is unknown or twice there. Known sections: {known}.")
            current = sections.setdefault(name, [])
        else:
            current.append(line)
    return sections


def _text(lines: list[str], name: str, path: Path) -> str:
    text = "\n".join(lines).strip()
    _require_slots(text, TASK_SLOTS if name == "task" else COMMON_SLOTS, path)
    return text


def _list(lines: list[str], name: str, path: Path) -> tuple[str, ...]:
    """Returns one entry per line that begins with a dash; continuation lines are indented."""
    entries: list[str] = []
    for line in lines:
        if line.startswith("- "):
            entries.append(line[2:].strip())
        elif line.startswith("  ") and line.strip() and entries:
            entries[-1] += " " + line.strip()
        elif line.strip():
            raise InputError(f"{path}: section {name.title()} is a list, got {line!r:.80}. Begin the line with a dash.")
    for entry in entries:
        _require_slots(entry, COMMON_SLOTS, path)
    return tuple(entries)


def _require_slots(text: str, known: tuple[str, ...], path: Path) -> None:
    unknown = next((slot for slot in SLOT.findall(text) if slot not in known), None)
    if unknown is not None:
        raise InputError(f"{path}: the slot {{{unknown}}} is unknown here. Known: {', '.join(known)}.")


def _word(entry: str, path: Path) -> Word:
    """Parses `femur, thigh bone @back => ...`."""
    left, arrow, description = entry.partition("=>")
    names, _, view = left.partition("@")
    words = tuple(word.strip().lower() for word in names.split(",") if word.strip())
    place = view.strip() or "all"
    if not arrow or not words or not description.strip() or place not in get_args(View):
        raise InputError(
            f"{path}: an entry of Words reads `word, word @view => description`, got {entry!r:.80}. Correct it."
        )
    return Word(words, place, description.strip())  # type: ignore[arg-type]
