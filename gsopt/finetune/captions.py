"""Reads the captions of a training scene, written beside it by the renderer of its mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsopt.data.files import is_regular, read_json
from gsopt.sds.conditioning import NEUTRAL_PROMPT, VIEW_WORDS

MAX_CAPTION_LENGTH = 120
"""Length to which captions are cut, characters."""


def read_captions(scene: Path) -> tuple[str, ...]:
    """Returns texts that describe the scene, the shortest complete description first; empty without a caption.

    Reads captions.json and object.json of `scripts/synth_views.py`. InputError for invalid JSON.
    """
    captions, known = _read(scene / "captions.json"), _read(scene / "object.json")
    caption, name, category = (
        _text(d.get(k)) for d, k in ((captions, "caption"), (known, "name"), (known, "category"))
    )
    if not caption:
        return ()
    views = captions.get("views")
    seen = {_text(text) for text in views.values()} if isinstance(views, dict) else set()
    named = [name, f"{name}, {category}"] if name else []
    sided = [f"{caption}, {word}" for word in VIEW_WORDS.values()]
    return tuple(dict.fromkeys(filter(None, [caption, f"a photo of {caption}", *named, *sided, *sorted(seen)])))


def generic_texts() -> tuple[str, ...]:
    """Texts that fit any scene."""
    return (NEUTRAL_PROMPT,)


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path) if is_regular(path) else {}
    return document if isinstance(document, dict) else {}


def _text(value: object) -> str:
    """Returns one line of printable lower-case words."""
    if not isinstance(value, str):
        return ""
    return " ".join("".join(c if c.isprintable() else " " for c in value[:MAX_CAPTION_LENGTH]).lower().split())
